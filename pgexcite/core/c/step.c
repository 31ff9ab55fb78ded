/* Steps of a system: the loop of pgexcite.core.step, operation by operation.

   Expects prepare, newton, check and update, and the sizes and constants, above it. */

#include <string.h>
#define N_W (N_X + N_Z)
#define AT_LEAST_1(n) ((n) > 0 ? (n) : 1)

/* What is hoisted out of stages with one coefficient c, of the parameters after so many renewals. */
typedef struct {
    double q[AT_LEAST_1(N_HOISTED)], reach[AT_LEAST_1(N_X)], c;
    long of;
} Prepared;

/* Two sets of hoisted values, so that a renewal of discrete states, which settles, does not lose what the steps use. */
typedef struct {
    double w[2][AT_LEAST_1(N_W)], start[AT_LEAST_1(N_W)], b[AT_LEAST_1(N_X)], slope[AT_LEAST_1(N_X)];
    double middle[AT_LEAST_1(N_W)], b_middle[AT_LEAST_1(N_X)], mass[AT_LEAST_1(N_X)], d_next[AT_LEAST_1(N_D)], c;
    Prepared prepared[2], *with;
    long renewals;
    int sloped;
    const double *d, *u, *p;
} Stage;

/* Squared residual at w; leaves the slope there in the stage. */
typedef double Check(Stage *s, const double *w);

static double work[SZ_W];
static casadi_int iwork[SZ_IW];
static const double *args[SZ_ARG];
static double *results[SZ_RES];

/* Has the values at hand that are hoisted out of stages with this coefficient. */
static void aim(Stage *s, double c) {
    Prepared *with = s->prepared + (c == FROZEN);
    s->c = c; s->with = with;
    if (with->of == s->renewals && with->c == c) return;
    args[0] = &s->c; args[1] = s->d; args[2] = s->u; args[3] = s->p;
    results[0] = with->q; results[1] = s->mass; results[2] = with->reach;
    prepare(args, results, iwork, work, 0);
    with->c = c; with->of = s->renewals;
}

/* Forgets what was computed of other parameters and at another point. */
static void renewed(Stage *s) {
    static long all;
    s->renewals = ++all;
    s->sloped = 0;
}

static double check_at(Stage *s, const double *w) {
    double norm2;
    args[0] = w; args[1] = s->b; args[2] = s->with->q;
    results[0] = &norm2; results[1] = s->slope;
    check(args, results, iwork, work, 0);
    return norm2;
}

/* Newton from s->w[0]; the solution is left there. Returns 1 when it converged, 2 when the slope there is known as well. */
static int solve(Stage *s, Check *check) {
    int k;
    for (k = 0; k < MAX_ITERATIONS; k++) {
        double *from = s->w[k & 1], *to = s->w[!(k & 1)], norms2[2], total;
        int done, checked = 0;
        args[0] = from; args[1] = s->b; args[2] = s->with->q;
        results[0] = to; results[1] = norms2;
        newton(args, results, iwork, work, 0);
        total = norms2[0] + UPDATE_WEIGHT * norms2[1];
        done = total < TOLERANCE2;
        if (!done && norms2[0] < PROMISING2 && UPDATE_WEIGHT * norms2[1] < TOLERANCE2)
            done = checked = check(s, to) < VERIFIED2;
        if (done) {
            if (to != s->w[0]) memcpy(s->w[0], to, sizeof(double) * N_W);
            return 1 + checked;
        }
        if (!(total < 1e20)) return 0;
    }
    return 0;
}

/* One step; its last point is checked by `last`. */
static int one_step(Stage *s, int rule, double h, int startup, double *x, double *z, Check *last) {
    int i, euler = rule == 2 || (rule == 1 && startup > 0), done;
    aim(s, euler ? h : rule == 1 ? h / 2 : GAMMA * h / 2);
    memcpy(s->start, x, sizeof(double) * N_X); memcpy(s->start + N_X, z, sizeof(double) * N_Z);
    if (!s->sloped) check_at(s, s->start);
    s->sloped = 0;
    memcpy(s->w[0], s->start, sizeof(double) * N_W);
    for (i = 0; i < N_X; i++) {
        double guess = s->with->reach[i] * s->slope[i];
        s->b[i] = s->mass[i] * x[i];
        if (!euler) {
            s->b[i] += s->c * s->slope[i];
            guess *= 2.0;
        }
        s->w[0][i] += guess;
    }
    done = solve(s, rule == 0 ? check_at : last);
    if (!done) {
        memcpy(s->w[0], s->start, sizeof(double) * N_W);
        done = solve(s, rule == 0 ? check_at : last);
        if (!done) return 0;
    }
    if (rule == 0) {
        memcpy(s->middle, s->w[0], sizeof(double) * N_W); memcpy(s->b_middle, s->b, sizeof(double) * N_X);
        for (i = 0; i < N_X; i++) s->b[i] = s->mass[i] * (ALPHA * s->w[0][i] - BETA * x[i]);
        for (i = 0; i < N_W; i++) s->w[0][i] += EXTRAPOLATE * (s->w[0][i] - s->start[i]);
        done = solve(s, last);
        if (!done) return 0;
    }
    s->sloped = done == 2;
    memcpy(x, s->w[0], sizeof(double) * N_X); memcpy(z, s->w[0] + N_X, sizeof(double) * N_Z);
    return 1;
}

/* Solves the algebraic unknowns again at fixed states, unless they are solved. */
static int settle(Stage *s, double *x, double *z) {
    int i;
    aim(s, FROZEN);
    for (i = 0; i < N_X; i++) s->b[i] = s->mass[i] * x[i];
    memcpy(s->w[0], x, sizeof(double) * N_X); memcpy(s->w[0] + N_X, z, sizeof(double) * N_Z);
    s->sloped = check_at(s, s->w[0]) < VERIFIED2;
    if (s->sloped) return 1;
    if (!solve(s, check_at)) return 0;
    memcpy(x, s->w[0], sizeof(double) * N_X); memcpy(z, s->w[0] + N_X, sizeof(double) * N_Z);
    return 1;
}

/* Renews the discrete states after a step from s->start. 0: nothing that matters to the equations; 1: the algebraic unknowns moved. */
static int renew(Stage *s, double h, double *x, double *z, double *d) {
    static const int switching[] = SWITCHING;
    int i, changed = 0;
    double moved = 0;
    memcpy(s->w[0], x, sizeof(double) * N_X); memcpy(s->w[0] + N_X, z, sizeof(double) * N_Z);
    args[0] = s->start; args[1] = s->w[0]; args[2] = d; args[3] = s->u; args[4] = s->p; args[5] = &h;
    results[0] = s->d_next;
    update(args, results, iwork, work, 0);
    for (i = 0; i < N_D; i++) changed |= switching[i] && s->d_next[i] != d[i];
    memcpy(d, s->d_next, sizeof(double) * N_D);
    if (!changed) return 0;
    renewed(s);
    memcpy(s->start, z, sizeof(double) * N_Z);
    if (!settle(s, x, z)) return 1;
    for (i = 0; i < N_Z; i++) {
        double move = z[i] > s->start[i] ? z[i] - s->start[i] : s->start[i] - z[i];
        if (move > moved) moved = move;
    }
    return moved > MOVED;
}
