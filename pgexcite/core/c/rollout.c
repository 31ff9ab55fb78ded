/* Predictions with exact sensitivities: the loop of pgexcite.core.prediction, operation by operation. Goes below step.c.

   Expects prepare_sensitivity, stage_sensitivity, slope_sensitivity and output_sensitivity. */

static double S[N_W * N_COLUMNS], S_next[N_W * N_COLUMNS], S_b[AT_LEAST_1(N_X) * N_COLUMNS], S_c[N_COMMANDS * N_COLUMNS];
static double S_slope[AT_LEAST_1(N_X) * N_COLUMNS];
static double S_y[N_SELECTED * N_COLUMNS];

/* What is hoisted out of the sensitivities, as in Prepared. */
static struct {
    double q[AT_LEAST_1(N_SENSE_HOISTED)], c;
    long of;
} sensing[2];

static const double *sense_aim(Stage *s, double c) {
    int k = c == FROZEN;
    if (sensing[k].of != s->renewals || sensing[k].c != c) {
        args[0] = &c; args[1] = s->d; args[2] = s->u; args[3] = s->p;
        results[0] = sensing[k].q;
        prepare_sensitivity(args, results, iwork, work, 0);
        sensing[k].of = s->renewals; sensing[k].c = c;
    }
    return sensing[k].q;
}

static void sense_stage(const double *q, const double *w, const double *b, double *to) {
    args[0] = w; args[1] = b; args[2] = q; args[3] = S_b; args[4] = S_c;
    results[0] = to;
    stage_sensitivity(args, results, iwork, work, 0);
}

/* S_b of mass * (alpha A - beta B). */
static void scale_by_mass(Stage *s, double alpha, const double *A, double beta, const double *B) {
    int i, k;
    for (k = 0; k < N_COLUMNS; k++)
        for (i = 0; i < N_X; i++) S_b[k * N_X + i] = s->mass[i] * (alpha * A[k * N_W + i] - beta * B[k * N_W + i]);
}

static void sense_step(Stage *s, int rule, int euler) {
    const double *q = sense_aim(s, s->c);
    int i, k;
    if (rule == 2 || euler) {
        scale_by_mass(s, 1, S, 0, S);
        sense_stage(q, s->w[0], s->b, S_next);
    } else {
        args[0] = s->start; args[1] = q; args[2] = S; args[3] = S_c;
        results[0] = S_slope;
        slope_sensitivity(args, results, iwork, work, 0);
        for (k = 0; k < N_COLUMNS; k++)
            for (i = 0; i < N_X; i++) S_b[k * N_X + i] = s->mass[i] * S[k * N_W + i] + s->c * S_slope[k * N_X + i];
        if (rule == 1) {
            sense_stage(q, s->w[0], s->b, S_next);
        } else {
            sense_stage(q, s->middle, s->b_middle, S_next);
            scale_by_mass(s, ALPHA, S_next, BETA, S);
            sense_stage(q, s->w[0], s->b, S_next);
        }
    }
    memcpy(S, S_next, sizeof S);
}

static void sense_settling(Stage *s, const double *x, const double *z) {
    int i;
    memcpy(s->start, x, sizeof(double) * N_X); memcpy(s->start + N_X, z, sizeof(double) * N_Z);
    for (i = 0; i < N_X; i++) s->b[i] = s->mass[i] * x[i];
    scale_by_mass(s, 1, S, 0, S);
    sense_stage(sense_aim(s, FROZEN), s->start, s->b, S_next);
    memcpy(S, S_next, sizeof S);
}

/* Selected outputs and their derivatives. */
static void sense_outputs(Stage *s, const double *x, const double *z, double *y, double *to_y) {
    const double *q = sense_aim(s, s->c);
    memcpy(s->start, x, sizeof(double) * N_X); memcpy(s->start + N_X, z, sizeof(double) * N_Z);
    args[0] = s->start; args[1] = q; args[2] = s->d; args[3] = S; args[4] = S_c;
    results[0] = y; results[1] = to_y;
    output_sensitivity(args, results, iwork, work, 0);
}

/* Directions of the sensitivities at the start of a piece: the commands of its move; of a sample also, if transitions are wanted,
   each state by itself. */
static void point_at(int move, int fresh_sample) {
    int i;
    if (TRANSITION && !fresh_sample) return;
    memset(S_c, 0, sizeof S_c);
    if (TRANSITION) {
        memset(S, 0, sizeof S);
        for (i = 0; i < N_X; i++) S[i * N_W + i] = 1;
        for (i = 0; i < N_COMMANDS; i++) S_c[(N_X + i) * N_COMMANDS + i] = 1;
    } else {
        for (i = 0; i < N_COMMANDS; i++) S_c[(move * N_COMMANDS + i) * N_COMMANDS + i] = 1;
    }
}

/* Rolls out N pieces of count[j] steps of length h[j] under moves[move[j]], parameters and other commands of row[j]; outputs and
   derivatives after each piece that ends a sample. Returns how many pieces were completed. */
PGEXCITE_PUBLIC int pgexcite_rollout(int rule, int N, const int *count, const double *h, const int *move, const int *row,
                                     const int *end, const int *commands, int startup, double *x, double *z, double *d,
                                     const double *p_rows, const double *u_rows, const double *moves, int derivatives, double *y,
                                     double *dy, double *dx) {
    static Stage s;
    static double u[AT_LEAST_1(N_U)], u_last[AT_LEAST_1(N_U)];
    int j, i, k, sample = 0, fresh = 1;
    memcpy(u_last, u_rows, sizeof(double) * N_U);
    s.d = d; s.u = u_last; s.p = p_rows;
    renewed(&s);
    aim(&s, FROZEN);
    memset(S, 0, sizeof S); memset(S_c, 0, sizeof S_c);
    for (j = 0; j < N; j++) {
        int changed = j > 0 && row[j] != row[j - 1];
        memcpy(u, u_rows + (long)row[j] * N_U, sizeof(double) * N_U);
        for (i = 0; i < N_COMMANDS; i++) u[commands[i]] = moves[move[j] * N_COMMANDS + i];
        for (i = 0; i < N_U; i++) changed |= u[i] != u_last[i];
        s.u = u; s.p = p_rows + (long)row[j] * N_P;
        if (changed) {
            renewed(&s);
            if (!settle(&s, x, z)) return j;
            startup = STARTUP_STEPS;
            memcpy(u_last, u, sizeof(double) * N_U);
        }
        if (derivatives && (fresh || changed)) {
            point_at(move[j], fresh);
            sense_settling(&s, x, z);
        }
        for (k = 0; k < count[j]; k++) {
            int euler = rule == 1 && startup > 0;
            if (!one_step(&s, rule, h[j], startup, x, z, check_at)) return j;
            if (derivatives) sense_step(&s, rule, euler);
            if (startup > 0) startup--;
            if (N_D > 0 && renew(&s, h[j], x, z, d)) {
                startup = STARTUP_STEPS;
                if (derivatives) sense_settling(&s, x, z);
            }
        }
        fresh = end[j];
        if (!end[j]) continue;
        sense_outputs(&s, x, z, y + sample * N_SELECTED, derivatives ? dy + (long)sample * N_SELECTED * N_COLUMNS : S_y);
        if (derivatives && TRANSITION)
            for (k = 0; k < N_COLUMNS; k++) memcpy(dx + ((long)sample * N_COLUMNS + k) * N_X, S + k * N_W, sizeof(double) * N_X);
        sample++;
    }
    return N;
}
