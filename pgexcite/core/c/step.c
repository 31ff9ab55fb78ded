/* Steps of a system: the loop of pgexcite.core.step, operation by operation.

   Expects newton, history and update, and the sizes and constants, above it. */

#include <string.h>
#define N_W (N_X + N_Z)
#define AT_LEAST_1(n) ((n) > 0 ? (n) : 1)

typedef struct {
    double w[2][AT_LEAST_1(N_W)], start[AT_LEAST_1(N_W)], b[AT_LEAST_1(N_X)];
    double middle[AT_LEAST_1(N_W)], b_middle[AT_LEAST_1(N_X)], mass[AT_LEAST_1(N_X)], d_next[AT_LEAST_1(N_D)], c, norm;
    const double *d, *u, *p;
} Stage;

static double work[SZ_W];
static casadi_int iwork[SZ_IW];
static const double *args[SZ_ARG];
static double *results[SZ_RES];

static void history_at(Stage *s, const double *x, const double *z) {
    args[0] = x; args[1] = z; args[2] = s->d; args[3] = s->u; args[4] = s->p; args[5] = &s->c;
    results[0] = s->b; results[1] = s->mass;
    history(args, results, iwork, work, 0);
}

/* Newton from s->w[0]; the solution is left there. Returns 1 when it converged. */
static int solve(Stage *s) {
    int k;
    for (k = 0; k < MAX_ITERATIONS; k++) {
        double *from = s->w[k & 1], *to = s->w[!(k & 1)];
        args[0] = from; args[1] = s->b; args[2] = &s->c; args[3] = s->d; args[4] = s->u; args[5] = s->p;
        results[0] = to; results[1] = &s->norm;
        newton(args, results, iwork, work, 0);
        if (s->norm < TOLERANCE2) {
            double sum = 0; int i;
            if (to != s->w[0]) memcpy(s->w[0], to, sizeof(double) * N_W);
            for (i = 0; i < N_W; i++) sum += s->w[0][i];
            return sum - sum == 0;
        }
        if (!(s->norm < 1e20)) return 0;
    }
    return 0;
}

static int one_step(Stage *s, int rule, double h, int startup, double *x, double *z) {
    int i;
    memcpy(s->start, x, sizeof(double) * N_X); memcpy(s->start + N_X, z, sizeof(double) * N_Z);
    memcpy(s->w[0], s->start, sizeof(double) * N_W);
    if (rule == 2 || (rule == 1 && startup > 0)) {
        s->c = h;
        for (i = 0; i < N_X; i++) s->b[i] = s->mass[i] * x[i];
    } else {
        s->c = rule == 1 ? h / 2 : GAMMA * h / 2;
        history_at(s, x, z);
    }
    if (!solve(s)) return 0;
    if (rule == 0) {
        memcpy(s->middle, s->w[0], sizeof(double) * N_W); memcpy(s->b_middle, s->b, sizeof(double) * N_X);
        for (i = 0; i < N_X; i++) s->b[i] = s->mass[i] * (ALPHA * s->w[0][i] - BETA * x[i]);
        for (i = 0; i < N_W; i++) s->w[0][i] += EXTRAPOLATE * (s->w[0][i] - s->start[i]);
        if (!solve(s)) return 0;
    }
    memcpy(x, s->w[0], sizeof(double) * N_X); memcpy(z, s->w[0] + N_X, sizeof(double) * N_Z);
    return 1;
}

/* Solves the algebraic unknowns again at fixed states. */
static int settle(Stage *s, double *x, double *z) {
    int i;
    s->c = FROZEN;
    for (i = 0; i < N_X; i++) s->b[i] = s->mass[i] * x[i];
    memcpy(s->w[0], x, sizeof(double) * N_X); memcpy(s->w[0] + N_X, z, sizeof(double) * N_Z);
    if (!solve(s)) return 0;
    memcpy(x, s->w[0], sizeof(double) * N_X); memcpy(z, s->w[0] + N_X, sizeof(double) * N_Z);
    return 1;
}

/* Renews the discrete states. 0: nothing that matters to the equations; 1: the algebraic unknowns moved. */
static int renew(Stage *s, double h, double *x, double *z, double *d) {
    int i, changed = 0;
    double moved = 0;
    args[0] = x; args[1] = z; args[2] = d; args[3] = s->u; args[4] = s->p; args[5] = &h;
    results[0] = s->d_next;
    update(args, results, iwork, work, 0);
    for (i = 0; i < N_D; i++) changed |= s->d_next[i] != d[i];
    if (!changed) return 0;
    memcpy(d, s->d_next, sizeof(double) * N_D);
    memcpy(s->start, z, sizeof(double) * N_Z);
    if (!settle(s, x, z)) return 1;
    for (i = 0; i < N_Z; i++) {
        double move = z[i] > s->start[i] ? z[i] - s->start[i] : s->start[i] - z[i];
        if (move > moved) moved = move;
    }
    return moved > MOVED;
}
