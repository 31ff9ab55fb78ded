/* Predictions with exact sensitivities: the loops of pgexcite.core.prediction and sensing, operation by operation. Goes below step.c
   and lanes.c.

   Expects what pgexcite.core.sensitivity writes: prepare_sensitivity, prepare_commanded, and of a stage, of its slope and of the
   outputs the factors at a point and the derivative along a direction. */

static lanes S[N_BLOCKS][N_W], S_next[N_BLOCKS][N_W], S_b[N_BLOCKS][AT_LEAST_1(N_X)], S_c[N_BLOCKS][N_COMMANDS];
static lanes S_slope[N_BLOCKS][AT_LEAST_1(N_X)], S_y[N_BLOCKS][N_SELECTED];

/* Element i of column k. */
#define ELEMENT(of, k, i) (((double *)of[(k) / LANES])[(i) * LANES + (k) % LANES])

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

/* Renews of what is hoisted with coefficient c what depends on the commands, alone. */
static void renew_commanded(Stage *s, double c, double *of_kernel, double *of_own) {
    static const int at[] = COMMANDED, own_at[] = SENSE_COMMANDED;
    static double values[AT_LEAST_1(N_COMMANDED)], own[AT_LEAST_1(N_SENSE_COMMANDED)];
    int i;
    args[0] = &c; args[1] = s->d; args[2] = s->u; args[3] = s->p;
    results[0] = values; results[1] = own;
    prepare_commanded(args, results, iwork, work, 0);
    if (of_kernel)
        for (i = 0; i < N_COMMANDED; i++) of_kernel[at[i]] = values[i];
    if (of_own)
        for (i = 0; i < N_SENSE_COMMANDED; i++) of_own[own_at[i]] = own[i];
}

/* Other commands, all else as it was. */
static void commanded(Stage *s) {
    int k;
    for (k = 0; k < 2; k++) {
        int stage = s->prepared[k].of == s->renewals, own = sensing[k].of == s->renewals;
        double c = stage ? s->prepared[k].c : sensing[k].c;
        if (stage && own && sensing[k].c != c) own = 0, sensing[k].of = 0;
        if (stage || own) renew_commanded(s, c, stage ? s->prepared[k].q : NULL, own ? sensing[k].q : NULL);
    }
    s->sloped = 0;
}

static void sense_stage(const double *q, const double *w, const double *b, lanes to[N_BLOCKS][N_W]) {
    static double factors[AT_LEAST_1(N_STAGE_FACTORS)];
    int k;
    args[0] = w; args[1] = b; args[2] = q;
    results[0] = factors;
    stage_factors(args, results, iwork, work, 0);
    for (k = 0; k < N_BLOCKS; k++) stage_along(factors, S_b[k], S_c[k], to[k]);
}

static void sense_slope(const double *q, const double *w) {
    static double factors[AT_LEAST_1(N_SLOPE_FACTORS)];
    int k;
    args[0] = w; args[1] = q;
    results[0] = factors;
    slope_factors(args, results, iwork, work, 0);
    for (k = 0; k < N_BLOCKS; k++) slope_along(factors, S[k], S_c[k], S_slope[k]);
}

/* S_b of mass * (alpha A - beta B). */
static void scale_by_mass(Stage *s, double alpha, lanes A[N_BLOCKS][N_W], double beta, lanes B[N_BLOCKS][N_W]) {
    int i, k;
    for (k = 0; k < N_BLOCKS; k++)
        for (i = 0; i < N_X; i++) S_b[k][i] = s->mass[i] * (alpha * A[k][i] - beta * B[k][i]);
}

/* S_b of mass * S. */
static void weigh(Stage *s) {
    int i, k;
    for (k = 0; k < N_BLOCKS; k++)
        for (i = 0; i < N_X; i++) S_b[k][i] = s->mass[i] * S[k][i];
}

static void sense_step(Stage *s, int rule, int euler) {
    const double *q = sense_aim(s, s->c);
    int i, k;
    weigh(s);
    if (rule != 2 && !euler) {
        sense_slope(q, s->start);
        for (k = 0; k < N_BLOCKS; k++)
            for (i = 0; i < N_X; i++) S_b[k][i] += s->c * S_slope[k][i];
        if (rule == 0) {
            sense_stage(q, s->middle, s->b_middle, S_next);
            scale_by_mass(s, ALPHA, S_next, BETA, S);
        }
    }
    sense_stage(q, s->w[0], s->b, S_next);
    memcpy(S, S_next, sizeof S);
}

static void sense_settling(Stage *s, const double *x, const double *z) {
    int i;
    memcpy(s->start, x, sizeof(double) * N_X); memcpy(s->start + N_X, z, sizeof(double) * N_Z);
    for (i = 0; i < N_X; i++) s->b[i] = s->mass[i] * x[i];
    weigh(s);
    sense_stage(sense_aim(s, FROZEN), s->start, s->b, S_next);
    memcpy(S, S_next, sizeof S);
}

/* Selected outputs and their derivatives, column by column. */
static void sense_outputs(Stage *s, const double *x, const double *z, double *y, double *to_y) {
    static double factors[AT_LEAST_1(N_OUTPUT_FACTORS)];
    const double *q = sense_aim(s, s->c);
    int k, i;
    memcpy(s->start, x, sizeof(double) * N_X); memcpy(s->start + N_X, z, sizeof(double) * N_Z);
    args[0] = s->start; args[1] = q; args[2] = s->d;
    results[0] = y; results[1] = factors;
    output_factors(args, results, iwork, work, 0);
    if (!to_y) return;
    for (k = 0; k < N_BLOCKS; k++) output_along(factors, S[k], S_c[k], S_y[k]);
    for (k = 0; k < N_COLUMNS; k++)
        for (i = 0; i < N_SELECTED; i++) to_y[k * N_SELECTED + i] = ELEMENT(S_y, k, i);
}

/* Directions of the sensitivities at the start of a piece: the commands of its move; of a sample also, if transitions are wanted,
   each state by itself. */
static void point_at(int move, int fresh_sample) {
    int i;
    if (TRANSITION && !fresh_sample) return;
    memset(S_c, 0, sizeof S_c);
    if (TRANSITION) {
        memset(S, 0, sizeof S);
        for (i = 0; i < N_X; i++) ELEMENT(S, i, i) = 1;
        for (i = 0; i < N_COMMANDS; i++) ELEMENT(S_c, N_X + i, i) = 1;
    } else {
        for (i = 0; i < N_COMMANDS; i++) ELEMENT(S_c, move * N_COMMANDS + i, i) = 1;
    }
}

/* Rolls out N pieces of count[j] steps of length h[j] under moves[move[j]], parameters and other commands of row[j]; outputs and
   derivatives after each piece that ends a sample. Returns how many pieces were completed. */
PGEXCITE_PUBLIC int pgexcite_rollout(int rule, int N, const int *count, const double *h, const int *move, const int *row,
                                     const int *end, const int *commands, int startup, double *x, double *z, double *d,
                                     const double *p_rows, const double *u_rows, const double *moves, int derivatives, double *y,
                                     double *dy, double *dx) {
    static Stage s;
    static double u[AT_LEAST_1(N_U)], wanted[AT_LEAST_1(N_U)];
    int j, k, i, sample = 0, fresh = 1;
    memcpy(u, u_rows, sizeof u);
    s.d = d; s.u = u; s.p = p_rows;
    renewed(&s);
    aim(&s, FROZEN);
    memset(S, 0, sizeof S); memset(S_c, 0, sizeof S_c);
    for (j = 0; j < N; j++) {
        int other = j > 0 && row[j] != row[j - 1], changed = other;
        memcpy(wanted, u_rows + (long)row[j] * N_U, sizeof wanted);
        for (i = 0; i < N_COMMANDS; i++) wanted[commands[i]] = moves[move[j] * N_COMMANDS + i];
        for (i = 0; i < N_U; i++) changed |= wanted[i] != u[i];
        if (changed) {
            memcpy(u, wanted, sizeof u);
            s.p = p_rows + (long)row[j] * N_P;
            if (other || COMMANDS_MASS)
                renewed(&s);
            else
                commanded(&s);
            if (!settle(&s, x, z)) return j;
            startup = STARTUP_STEPS;
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
        sense_outputs(&s, x, z, y + sample * N_SELECTED, derivatives ? dy + (long)sample * N_SELECTED * N_COLUMNS : NULL);
        if (derivatives && TRANSITION)
            for (k = 0; k < N_COLUMNS; k++)
                for (i = 0; i < N_X; i++) dx[((long)sample * N_COLUMNS + k) * N_X + i] = ELEMENT(S, k, i);
        sample++;
    }
    return N;
}
