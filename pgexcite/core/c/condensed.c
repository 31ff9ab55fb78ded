/* The quadratic program of a problem condensed to its moves, and its cost: the algorithm of pgexcite.core.condensed.

   Outputs come in the order voltages, speeds, soft-bounded. Goes below qp.c. */

#define N_TRACKED (N_OUTPUTS - N_SOFT)
#define N_RATES (RATE ? N_V : 0)

static int all_finite(const double *a, int n) {
    int i;
    for (i = 0; i < n; i++)
        if (a[i] - a[i] != 0) return 0;
    return 1;
}

/* Within the bounds, and on a bound that is met but for rounding. */
static double clipped(double value, int i) {
    if (value < LOWER[i] + 1e-12) return LOWER[i];
    return value > UPPER[i] - 1e-12 ? UPPER[i] : value;
}

/* A plan one sample later. */
static void shift(const double *from, double *to) {
    int k, i;
    for (k = 0; k < N_MOVES; k++)
        for (i = 0; i < N_COMMANDS; i++) to[k * N_COMMANDS + i] = from[SHIFTED[k] * N_COMMANDS + i];
}

/* What is tracked at the end of each sample of a horizon that begins at t, as far as it is known now: the latest change holds. */
static void references(double t, double now, double *to) {
    int j, i, k;
    for (j = 0; j < HORIZON; j++) {
        const double *value = V_REF;
        double since = -INFINITY;
        for (k = 0; k < N_PREVIEWS; k++)
            if (since <= PREVIEW_T[k] && PREVIEW_T[k] <= t + ENDS[j] + 1e-9) {
                value = PREVIEW_V + k * N_VOLTAGES;
                since = PREVIEW_T[k];
            }
        for (k = 0; k < N_STEPS; k++)
            if (since <= STEP_T[k] && STEP_T[k] <= now + 1e-9) {
                value = STEP_V + k * N_VOLTAGES;
                since = STEP_T[k];
            }
        for (i = 0; i < N_TRACKED; i++) to[j * N_TRACKED + i] = i < N_VOLTAGES ? value[i] : 1;
    }
}

static void moves_of(const double *plan, const double *u_last, double *moves) {
    int i;
    for (i = 0; i < N_V; i++) moves[i] = plan[i] - (i < N_COMMANDS ? u_last[i] : plan[i - N_COMMANDS]);
}

/* By how much a soft-bounded output is outside. */
static double excess(double y, int i) {
    double above = y - SOFT_UPPER[i], below = SOFT_LOWER[i] - y;
    return (above > 0 ? above : 0) + (below > 0 ? below : 0);
}

static double cost_of(const double *y, const double *targets, const double *plan, const double *u_last) {
    double total = 0, moves[N_V];
    int j, i;
    for (j = 0; j < HORIZON; j++)
        for (i = 0; i < N_TRACKED; i++) {
            double error = y[j * N_OUTPUTS + i] - targets[j * N_TRACKED + i];
            total += WEIGHTS[j * N_TRACKED + i] * error * error;
        }
    moves_of(plan, u_last, moves);
    for (i = 0; i < N_V; i++) total += R[i] * moves[i] * moves[i];
    for (j = 0; j < HORIZON; j++)
        for (i = 0; i < N_SOFT; i++) {
            double outside = excess(y[j * N_OUTPUTS + N_TRACKED + i], i);
            total += SOFT_WEIGHT[i] * outside * outside;
        }
    return total;
}

/* Derivative of output s of sample j to move i; G points to the first move of the first sample. */
#define TO_MOVE(j, i, s) (G[(long)(j) * stride + (i) * N_OUTPUTS + (s)])

/* Rows of the program: differences of consecutive commands, then soft-bounded outputs. */
static void make_rows(const double *y, const double *G, int stride, const double *moves, double *rows, double *low, double *high,
                      double *give) {
    int i, j, k, r = 0;
    memset(rows, 0, sizeof(double) * N_RATES * N_V);
    for (; r < N_RATES; r++) {
        rows[r * N_V + r] = 1;
        if (r >= N_COMMANDS) rows[r * N_V + r - N_COMMANDS] = -1;
        low[r] = -DU_MAX[r] - moves[r];
        high[r] = DU_MAX[r] - moves[r];
        give[r] = 0;
    }
    for (j = 0; j < HORIZON; j++)
        for (i = 0; i < N_SOFT; i++, r++) {
            double value = y[j * N_OUTPUTS + N_TRACKED + i];
            for (k = 0; k < N_V; k++) rows[r * N_V + k] = TO_MOVE(j, k, N_TRACKED + i);
            low[r] = SOFT_LOWER[i] - value;
            high[r] = SOFT_UPPER[i] - value;
            give[r] = 0.5 / SOFT_WEIGHT[i];
        }
}

/* Slope of what soft bounds cost along a step. */
static double slope_of_soft(const double *y, const double *G, int stride, const double *step) {
    double total = 0;
    int j, i, k;
    for (j = 0; j < HORIZON; j++)
        for (i = 0; i < N_SOFT; i++) {
            double value = y[j * N_OUTPUTS + N_TRACKED + i], along = 0;
            for (k = 0; k < N_V; k++) along += TO_MOVE(j, k, N_TRACKED + i) * step[k];
            total += 2 * SOFT_WEIGHT[i] * excess(value, i) * (value > SOFT_UPPER[i] ? along : -along);
        }
    return total;
}

/* The Gauss-Newton step from a plan, and its slope of the cost; 0 where the program was not solved. */
static int direction_of(const double *y, const double *G, int stride, const double *targets, const double *plan,
                        const double *u_last, double *step, double *slope) {
    static double H[N_V * N_V], g[N_V], lower[N_V], upper[N_V], moves[N_V];
    static double rows[AT_LEAST_1(N_ROWS) * N_V], low[AT_LEAST_1(N_ROWS)], high[AT_LEAST_1(N_ROWS)], give[AT_LEAST_1(N_ROWS)];
    static const Program program = {H, g, lower, upper, rows, low, high, give};
    int j, i, k, s;
    memset(H, 0, sizeof H); memset(g, 0, sizeof g);
    for (j = 0; j < HORIZON; j++)
        for (s = 0; s < N_TRACKED; s++) {
            double weight = 2 * WEIGHTS[j * N_TRACKED + s], error = y[j * N_OUTPUTS + s] - targets[j * N_TRACKED + s];
            for (i = 0; i < N_V; i++) {
                double weighted = weight * TO_MOVE(j, i, s);
                if (weighted == 0) continue;
                g[i] += weighted * error;
                for (k = 0; k <= i; k++) H[i * N_V + k] += weighted * TO_MOVE(j, k, s);
            }
        }
    moves_of(plan, u_last, moves);
    for (i = 0; i < N_V; i++) {
        H[i * N_V + i] += 2 * R[i];
        g[i] += 2 * R[i] * moves[i];
        if (i >= N_COMMANDS) {
            H[(i - N_COMMANDS) * N_V + i - N_COMMANDS] += 2 * R[i];
            H[i * N_V + i - N_COMMANDS] -= 2 * R[i];
            g[i - N_COMMANDS] -= 2 * R[i] * moves[i];
        }
        lower[i] = LOWER[i] - plan[i];
        upper[i] = UPPER[i] - plan[i];
    }
    for (i = 0; i < N_V; i++)
        for (k = i + 1; k < N_V; k++) H[i * N_V + k] = H[k * N_V + i];
    make_rows(y, G, stride, moves, rows, low, high, give);
    if (!qp_solve(&program, step)) return 0;
    *slope = slope_of_soft(y, G, stride, step);
    for (i = 0; i < N_V; i++) *slope += g[i] * step[i];
    return 1;
}
