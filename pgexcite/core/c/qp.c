/* Strictly convex quadratic programs with bounds on the variables and on rows, solved exactly by the dual active set method:
   D. Goldfarb, A. Idnani, "A numerically stable dual method for solving strictly convex quadratic programs",
   Mathematical Programming 27 (1983) 1-33. Sizes are fixed, memory is static, the number of iterations is capped.

       min x'Hx/2 + g'x + sum s_r^2 / (2 give_r)    lower <= x <= upper    row_lower - s <= rows x <= row_upper + s

   A row that gives 0 is hard. The slack of one that gives is its multiplier times what it gives, and is no variable: it has a
   direction of its own, so all it does is to add what the row gives to the row's place on the diagonal of the Gram matrix.

   A program without rows is tried by block principal pivoting first, as pgexcite.core.qp does: a few small factorisations.

   Goes below dense.c. Expects N_V variables and N_ROWS rows, and the limits of pgexcite.core.qp (QP_...). */

#include <math.h>
#include <string.h>

#define QP_BOUNDED (N_V + N_ROWS)
#define QP_SPACE (QP_BOUNDED + 1)
#define QP_MAX_ITERATIONS (10 * QP_BOUNDED + 50)

typedef struct {
    const double *H, *g;
    const double *lower, *upper;                      /* N_V */
    const double *rows, *row_lower, *row_upper, *give; /* N_ROWS x N_V, N_ROWS */
} Program;

static double qp_L[N_V * N_V], qp_W[QP_SPACE * N_V], qp_gram[QP_SPACE * QP_SPACE], qp_multiplier[QP_SPACE], qp_r[QP_SPACE];
static int qp_active[QP_SPACE], qp_q, qp_is_active[2 * QP_BOUNDED];

/* Constraints are n'x >= b: 2k is the lower bound of the k-th variable or row, 2k + 1 the upper one. */
static void qp_normal(const Program *of, int c, double *n) {
    int i, k = c / 2;
    double sign = c % 2 ? -1 : 1;
    for (i = 0; i < N_V; i++) n[i] = k < N_V ? (i == k ? sign : 0) : sign * of->rows[(k - N_V) * N_V + i];
}

static double qp_value(const Program *of, int k, const double *x) {
    double value = 0;
    int i;
    if (k < N_V) return x[k];
    for (i = 0; i < N_V; i++) value += of->rows[(k - N_V) * N_V + i] * x[i];
    return value;
}

static double qp_bound(const Program *of, int c) {
    int k = c / 2;
    if (c % 2) return -(k < N_V ? of->upper[k] : of->row_upper[k - N_V]);
    return k < N_V ? of->lower[k] : of->row_lower[k - N_V];
}

static double qp_give(const Program *of, int c) { return c / 2 < N_V ? 0 : of->give[c / 2 - N_V]; }

/* What is left to a constraint's bound at x, negative where it is crossed. */
static double qp_margin(const Program *of, int c, const double *x) {
    double value = qp_value(of, c / 2, x);
    return (c % 2 ? -value : value) - qp_bound(of, c);
}

/* Solves (W W' + give) r = r in place, W the active normals in the metric of H; 0 where they are dependent. */
static int qp_solve_gram(const Program *of, double *r) {
    int a, b, i;
    for (a = 0; a < qp_q; a++) {
        for (b = 0; b < qp_q; b++) {
            double sum = 0;
            for (i = 0; i < N_V; i++) sum += qp_W[a * N_V + i] * qp_W[b * N_V + i];
            qp_gram[a * qp_q + b] = sum;
        }
        qp_gram[a * qp_q + a] += qp_give(of, qp_active[a]);
    }
    if (!cholesky(qp_gram, qp_q)) return 0;
    forward(qp_gram, qp_q, r);
    backward(qp_gram, qp_q, r);
    return 1;
}

static void qp_drop(int a) {
    int k;
    qp_is_active[qp_active[a]] = 0;
    for (k = a; k < qp_q - 1; k++) {
        qp_active[k] = qp_active[k + 1];
        qp_multiplier[k] = qp_multiplier[k + 1];
        memcpy(qp_W + k * N_V, qp_W + (k + 1) * N_V, sizeof(double) * N_V);
    }
    qp_q--;
}

/* The constraint crossed most, -1 where none is. Those that are active hold, with their slacks. */
static int qp_most_crossed(const Program *of, const double *x, double *margin) {
    int c, chosen = -1;
    *margin = 0;
    for (c = 0; c < 2 * QP_BOUNDED; c++) {
        double left = qp_is_active[c] ? 0 : qp_margin(of, c, x);
        if (left < *margin && left < -1e-12 * (1 + fabs(qp_bound(of, c)))) {
            *margin = left;
            chosen = c;
        }
    }
    return chosen;
}

/* Makes a crossed constraint active, and drops those whose multipliers get to zero on the way; 0 where that cannot be done. */
static int qp_add(const Program *of, int chosen, double margin, double *x, int *iteration) {
    static double v[N_V], z[N_V];
    double added = 0;
    int i, k;
    qp_normal(of, chosen, v);
    forward(qp_L, N_V, v);
    for (;;) {
        double own = qp_give(of, chosen), vv = own, zz = own, partial = INFINITY, full, t;
        int leaving = -1;
        if (++*iteration > QP_MAX_ITERATIONS) return 0;
        for (k = 0; k < qp_q; k++) {
            qp_r[k] = 0;
            for (i = 0; i < N_V; i++) qp_r[k] += qp_W[k * N_V + i] * v[i];
        }
        if (!qp_solve_gram(of, qp_r)) return 0;
        for (i = 0; i < N_V; i++) {
            z[i] = v[i];
            for (k = 0; k < qp_q; k++) z[i] -= qp_r[k] * qp_W[k * N_V + i];
            vv += v[i] * v[i];
            zz += z[i] * z[i];
        }
        for (k = 0; k < qp_q; k++) {
            zz += qp_r[k] * qp_r[k] * qp_give(of, qp_active[k]);
            if (qp_r[k] > 0 && qp_multiplier[k] / qp_r[k] < partial) {
                partial = qp_multiplier[k] / qp_r[k];
                leaving = k;
            }
        }
        full = zz > 1e-16 * vv ? -margin / zz : INFINITY;
        t = full < partial ? full : partial;
        if (!(t < INFINITY)) return 0;
        if (full < INFINITY) {
            backward(qp_L, N_V, z);
            for (i = 0; i < N_V; i++) x[i] += t * z[i];
            margin += t * zz;
        }
        for (k = 0; k < qp_q; k++) qp_multiplier[k] -= t * qp_r[k];
        added += t;
        if (full <= partial) {
            memcpy(qp_W + qp_q * N_V, v, sizeof v);
            qp_is_active[chosen] = 1;
            qp_active[qp_q] = chosen;
            qp_multiplier[qp_q++] = added;
            return 1;
        }
        qp_drop(leaving);
    }
}

/* Minimises over the variables on no side, the others at the bound of their side; 0 where H is not positive definite there. */
static int qp_minimise(const Program *of, const int *side, double *x) {
    static double A[N_V * N_V], r[N_V];
    int index[N_V], n = 0, a, b, i, k;
    for (i = 0; i < N_V; i++) {
        if (side[i])
            x[i] = side[i] > 0 ? of->upper[i] : of->lower[i];
        else
            index[n++] = i;
    }
    for (a = 0; a < n; a++) {
        i = index[a];
        r[a] = -of->g[i];
        for (k = 0; k < N_V; k++)
            if (side[k]) r[a] -= of->H[i * N_V + k] * x[k];
        for (b = 0; b <= a; b++) A[a * n + b] = of->H[i * N_V + index[b]];
    }
    if (!cholesky(A, n)) return 0;
    forward(A, n, r);
    backward(A, n, r);
    for (a = 0; a < n; a++) x[index[a]] = r[a];
    return 1;
}

/* Block principal pivoting for bounds alone: all variables on a wrong side change it at once, while that makes them fewer; else the
   last of them alone. 0 where the active set is not found in a few exchanges. */
static int qp_pivot(const Program *of, double *x) {
    int side[N_V], wrong[N_V], fewest = N_V + 1, patience = QP_PATIENCE, k, i, j;
    double scale = 1;
    memset(side, 0, sizeof side);
    for (i = 0; i < N_V; i++) {
        if (!(of->lower[i] <= of->upper[i])) return 0;
        if (fabs(of->g[i]) > scale) scale = fabs(of->g[i]);
    }
    for (k = 0; k < QP_MAX_EXCHANGES; k++) {
        int count = 0, last = 0;
        if (!qp_minimise(of, side, x)) return 0;
        for (i = 0; i < N_V; i++) {
            double slope = -of->g[i];
            for (j = 0; j < N_V; j++) slope -= of->H[i * N_V + j] * x[j];
            if (!side[i] && !(fabs(slope) <= QP_STATIONARY * scale)) return 0;
            wrong[i] = side[i] ? side[i] * slope < 0 : x[i] > of->upper[i] + QP_CROSSED || x[i] < of->lower[i] - QP_CROSSED;
            count += wrong[i];
            if (wrong[i]) last = i;
        }
        if (!count) return 1;
        if (count < fewest) {
            fewest = count;
            patience = QP_PATIENCE;
        } else if (patience-- <= 0) {
            memset(wrong, 0, sizeof wrong);
            wrong[last] = 1;
        }
        for (i = 0; i < N_V; i++)
            if (wrong[i]) side[i] = side[i] ? 0 : x[i] > of->upper[i] ? 1 : -1;
    }
    return 0;
}

/* Within the bounds, past rounding; 0 where it is not finite. */
static int qp_inside(const Program *of, double *x) {
    int i;
    for (i = 0; i < N_V; i++) {
        if (x[i] < of->lower[i]) x[i] = of->lower[i];
        if (x[i] > of->upper[i]) x[i] = of->upper[i];
        if (x[i] - x[i] != 0) return 0;
    }
    return 1;
}

/* Returns 1 with the minimiser in x; 0 where there is none, H is not positive definite, or the cap was reached. */
static int qp_solve(const Program *of, double *x) {
    static double free_x[N_V];
    double margin;
    int i, k, iteration = 0, chosen;
    if (!N_ROWS && qp_pivot(of, x)) return qp_inside(of, x);
    memcpy(qp_L, of->H, sizeof qp_L);
    if (!cholesky(qp_L, N_V)) return 0;
    for (i = 0; i < N_V; i++) x[i] = -of->g[i];
    forward(qp_L, N_V, x);
    backward(qp_L, N_V, x);
    memcpy(free_x, x, sizeof free_x);
    qp_q = 0;
    memset(qp_is_active, 0, sizeof qp_is_active);
    while ((chosen = qp_most_crossed(of, x, &margin)) >= 0)
        if (++iteration > QP_MAX_ITERATIONS || !qp_add(of, chosen, margin, x, &iteration)) return 0;
    /* Once more from the active set alone: what the steps have gathered in rounding errors goes. */
    for (k = 0; k < qp_q; k++) qp_r[k] = -qp_margin(of, qp_active[k], free_x);
    if (!qp_solve_gram(of, qp_r)) return 0;
    for (i = 0; i < N_V; i++) {
        x[i] = 0;
        for (k = 0; k < qp_q; k++) x[i] += qp_r[k] * qp_W[k * N_V + i];
    }
    backward(qp_L, N_V, x);
    for (i = 0; i < N_V; i++) x[i] += free_x[i];
    return qp_inside(of, x);
}
