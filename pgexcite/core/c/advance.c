/* Consecutive steps, recorded: the loop of pgexcite.core.step. Goes below step.c. Expects outputs. */

/* Takes up to n steps and records each; returns how many were taken. */
PGEXCITE_PUBLIC int pgexcite_advance(int rule, double h, int n, int *startup, double *x, double *z, double *d, const double *u,
                                     const double *p, double *rows_x, double *rows_z, double *rows_d, double *rows_y) {
    static Stage s;
    int k;
    s.d = d; s.u = u; s.p = p; s.c = 0;
    history_at(&s, x, z);
    for (k = 0; k < n; k++) {
        if (!one_step(&s, rule, h, *startup, x, z)) return k;
        if (*startup > 0) --*startup;
        if (N_D > 0 && renew(&s, h, x, z, d)) *startup = STARTUP_STEPS;
        memcpy(rows_x + (long)k * N_X, x, sizeof(double) * N_X);
        memcpy(rows_z + (long)k * N_Z, z, sizeof(double) * N_Z);
        memcpy(rows_d + (long)k * N_D, d, sizeof(double) * N_D);
        args[0] = x; args[1] = z; args[2] = d; args[3] = u; args[4] = p;
        results[0] = rows_y + (long)k * N_Y;
        outputs(args, results, iwork, work, 0);
    }
    return k;
}
