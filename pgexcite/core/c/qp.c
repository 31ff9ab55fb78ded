/* Strictly convex quadratic programs with bounds on the variables and on their differences, solved exactly by the dual active set
   method: D. Goldfarb, A. Idnani, "A numerically stable dual method for solving strictly convex quadratic programs",
   Mathematical Programming 27 (1983) 1-33. Sizes are fixed, memory is static, the number of iterations is capped.

       min x'Hx/2 + g'x    lower <= x <= upper    row_lower <= x_i - x_{i - N_COMMANDS} <= row_upper (if RATE)

   Goes below dense.c. Expects N_V variables, N_COMMANDS and RATE. */

#include <math.h>
#include <string.h>

#define QP_ROWS (RATE ? N_V : 0)
#define QP_CONSTRAINTS (2 * (N_V + QP_ROWS))
#define QP_MAX_ITERATIONS (10 * N_V + 50)

static double qp_L[N_V * N_V], qp_W[(N_V + 1) * N_V], qp_gram[N_V * N_V], qp_multiplier[N_V + 1], qp_r[N_V + 1];
static int qp_active[N_V + 1], qp_q;

/* Constraints are n'x >= b, numbered: lower bounds, upper bounds, lower rows, upper rows. */
static void qp_normal(int c, double *n) {
    double sign = c / N_V % 2 ? -1 : 1;
    int i = c % N_V;
    memset(n, 0, sizeof(double) * N_V);
    n[i] = sign;
    if (c >= 2 * N_V && i >= N_COMMANDS) n[i - N_COMMANDS] = -sign;
}

static double qp_value(int c, const double *x) {
    int i = c % N_V;
    double value = c >= 2 * N_V && i >= N_COMMANDS ? x[i] - x[i - N_COMMANDS] : x[i];
    return c / N_V % 2 ? -value : value;
}

static double qp_bound(int c, const double *lower, const double *upper, const double *row_lower, const double *row_upper) {
    int i = c % N_V;
    switch (c / N_V) {
        case 0: return lower[i];
        case 1: return -upper[i];
        case 2: return row_lower[i];
        default: return -row_upper[i];
    }
}

/* Solves W W' r = r in place, W the active normals in the metric of H; 0 where they are dependent. */
static int qp_solve_gram(double *r) {
    int a, b, i;
    for (a = 0; a < qp_q; a++)
        for (b = 0; b < qp_q; b++) {
            double sum = 0;
            for (i = 0; i < N_V; i++) sum += qp_W[a * N_V + i] * qp_W[b * N_V + i];
            qp_gram[a * qp_q + b] = sum;
        }
    if (!cholesky(qp_gram, qp_q)) return 0;
    forward(qp_gram, qp_q, r);
    backward(qp_gram, qp_q, r);
    return 1;
}

static void qp_drop(int a) {
    int k;
    for (k = a; k < qp_q - 1; k++) {
        qp_active[k] = qp_active[k + 1];
        qp_multiplier[k] = qp_multiplier[k + 1];
        memcpy(qp_W + k * N_V, qp_W + (k + 1) * N_V, sizeof(double) * N_V);
    }
    qp_q--;
}

/* Returns 1 with the minimiser in x; 0 where there is none, H is not positive definite, or the cap was reached. */
static int qp_solve(const double *H, const double *g, const double *lower, const double *upper, const double *row_lower,
                    const double *row_upper, double *x) {
    static double free_x[N_V], v[N_V], z[N_V], n[N_V];
    int i, k, c, iteration;
    memcpy(qp_L, H, sizeof qp_L);
    if (!cholesky(qp_L, N_V)) return 0;
    for (i = 0; i < N_V; i++) x[i] = -g[i];
    forward(qp_L, N_V, x);
    backward(qp_L, N_V, x);
    memcpy(free_x, x, sizeof free_x);
    qp_q = 0;
    for (iteration = 0; iteration < QP_MAX_ITERATIONS; iteration++) {
        double worst = 0, gap, added = 0;
        int chosen = -1;
        for (c = 0; c < QP_CONSTRAINTS; c++) {
            double b = qp_bound(c, lower, upper, row_lower, row_upper), s = qp_value(c, x) - b;
            if (s < worst && s < -1e-12 * (1 + fabs(b))) {
                worst = s;
                chosen = c;
            }
        }
        if (chosen < 0) break;
        gap = worst;
        qp_normal(chosen, n);
        memcpy(v, n, sizeof v);
        forward(qp_L, N_V, v);
        for (;;) {
            double vv = 0, zz = 0, partial = INFINITY, full, t;
            int leaving = -1;
            if (++iteration > QP_MAX_ITERATIONS) return 0;
            for (k = 0; k < qp_q; k++) {
                qp_r[k] = 0;
                for (i = 0; i < N_V; i++) qp_r[k] += qp_W[k * N_V + i] * v[i];
            }
            if (!qp_solve_gram(qp_r)) return 0;
            for (i = 0; i < N_V; i++) {
                z[i] = v[i];
                for (k = 0; k < qp_q; k++) z[i] -= qp_r[k] * qp_W[k * N_V + i];
                vv += v[i] * v[i];
                zz += z[i] * z[i];
            }
            for (k = 0; k < qp_q; k++)
                if (qp_r[k] > 0 && qp_multiplier[k] / qp_r[k] < partial) {
                    partial = qp_multiplier[k] / qp_r[k];
                    leaving = k;
                }
            full = zz > 1e-16 * vv ? -gap / zz : INFINITY;
            t = full < partial ? full : partial;
            if (!(t < INFINITY)) return 0;
            if (full < INFINITY) {
                backward(qp_L, N_V, z);
                for (i = 0; i < N_V; i++) x[i] += t * z[i];
                gap += t * zz;
            }
            for (k = 0; k < qp_q; k++) qp_multiplier[k] -= t * qp_r[k];
            added += t;
            if (full <= partial) {
                memcpy(qp_W + qp_q * N_V, v, sizeof v);
                qp_active[qp_q] = chosen;
                qp_multiplier[qp_q++] = added;
                break;
            }
            qp_drop(leaving);
        }
    }
    /* Once more from the active set alone: what the steps have gathered in rounding errors goes. */
    for (k = 0; k < qp_q; k++)
        qp_r[k] = qp_bound(qp_active[k], lower, upper, row_lower, row_upper) - qp_value(qp_active[k], free_x);
    if (!qp_solve_gram(qp_r)) return 0;
    for (i = 0; i < N_V; i++) {
        x[i] = 0;
        for (k = 0; k < qp_q; k++) x[i] += qp_r[k] * qp_W[k * N_V + i];
    }
    backward(qp_L, N_V, x);
    for (i = 0; i < N_V; i++) {
        x[i] += free_x[i];
        if (x[i] < lower[i]) x[i] = lower[i];
        if (x[i] > upper[i]) x[i] = upper[i];
        if (x[i] - x[i] != 0) return 0;
    }
    return iteration < QP_MAX_ITERATIONS;
}
