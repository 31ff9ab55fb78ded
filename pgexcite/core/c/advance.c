/* Consecutive steps, recorded: the loop of pgexcite.core.step. Goes below step.c. Expects land. */

static double *row_y;

/* As check_at, with the outputs, into the row that is recorded next. */
static double land_at(Stage *s, const double *w) {
    double norm2;
    args[0] = w; args[1] = s->b; args[2] = s->with->q; args[3] = s->d;
    results[0] = &norm2; results[1] = s->slope; results[2] = row_y;
    land(args, results, iwork, work, 0);
    return norm2;
}

/* Takes up to n steps and records each; returns how many were taken. */
PGEXCITE_PUBLIC int pgexcite_advance(int rule, double h, int n, int *startup, double *x, double *z, double *d, const double *u,
                                     const double *p, double *rows_x, double *rows_z, double *rows_d, double *rows_y) {
    static Stage s;
    int k;
    s.d = d; s.u = u; s.p = p;
    renewed(&s);
    for (k = 0; k < n; k++) {
        row_y = rows_y + (long)k * N_Y;
        /* Discrete states are renewed before outputs are recorded. */
        if (!one_step(&s, rule, h, *startup, x, z, N_D > 0 ? check_at : land_at)) return k;
        if (*startup > 0) --*startup;
        if (N_D > 0 && renew(&s, h, x, z, d)) *startup = STARTUP_STEPS;
        if (N_D > 0 || !s.sloped) {
            memcpy(s.start, x, sizeof(double) * N_X); memcpy(s.start + N_X, z, sizeof(double) * N_Z);
            land_at(&s, s.start);
            s.sloped = 1;
        }
        memcpy(rows_x + (long)k * N_X, x, sizeof(double) * N_X);
        memcpy(rows_z + (long)k * N_Z, z, sizeof(double) * N_Z);
        memcpy(rows_d + (long)k * N_D, d, sizeof(double) * N_D);
    }
    return k;
}
