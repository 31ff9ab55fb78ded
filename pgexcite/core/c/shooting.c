/* Plans by shooting: the algorithm of pgexcite.core.shooting. Goes below step.c, rollout.c and ladder.c.

   Expects the pieces of the horizon and N_SELECTED outputs, those of the program. */

#define N_Q (N_X + N_V)

typedef struct {
    double y[HORIZON * N_SELECTED], G[HORIZON * N_Q * N_SELECTED];
} Prediction;

typedef struct {
    int startup;
    double x[AT_LEAST_1(N_X)], z[AT_LEAST_1(N_Z)], d[AT_LEAST_1(N_D)], u[AT_LEAST_1(N_U)];
} Point;

static double plan[N_V];
static int has_plan;

/* What was prepared for the next sample, and the sample it is prepared from. */
static int prepared, has_origin;
static double prepared_plan[N_V], prepared_x[AT_LEAST_1(N_X)], prepared_p[AT_LEAST_1(N_P)];
static Prediction ready;
static Point origin;
static double origin_p[AT_LEAST_1(N_P)];

/* Set-points in force while this controller is in charge. */
static void fix(double *u) {
    int k;
    for (k = 0; k < N_FIXED; k++) u[FIXED_AT[k]] = FIXED_TO[k];
}

static int predict(const Point *from, const double *p, const double *moves, Prediction *to) {
    static double x[AT_LEAST_1(N_X)], z[AT_LEAST_1(N_Z)], d[AT_LEAST_1(N_D)], u[AT_LEAST_1(N_U)];
    static double dy[HORIZON * N_COLUMNS * N_SELECTED], dx[HORIZON * N_COLUMNS * AT_LEAST_1(N_X)], X[2 * N_Q * AT_LEAST_1(N_X)];
    int done;
    memcpy(x, from->x, sizeof x); memcpy(z, from->z, sizeof z); memcpy(d, from->d, sizeof d); memcpy(u, from->u, sizeof u);
    fix(u);
    memset(dy, 0, sizeof dy);
    done = pgexcite_rollout(RULE, N_PIECES, PIECE_COUNT, PIECE_LENGTH, PIECE_MOVE, PIECE_ROW, PIECE_END, COMMANDS, from->startup,
                            x, z, d, p, u, moves, 1, to->y, dy, dx);
    if (done != N_PIECES || !all_finite(to->y, HORIZON * N_SELECTED) || !all_finite(dy, HORIZON * N_COLUMNS * N_SELECTED)) return 0;
    pgexcite_condense(HORIZON, N_MOVES, SAMPLE_MOVE, dy, dx, X, to->G);
    return 1;
}

/* One sample of the plant under these commands. */
static int advance(Point *at, const double *p, const double *commands) {
    static double rows_x[FIRST_COUNT * AT_LEAST_1(N_X)], rows_z[FIRST_COUNT * AT_LEAST_1(N_Z)];
    static double rows_d[FIRST_COUNT * AT_LEAST_1(N_D)], rows_y[FIRST_COUNT * AT_LEAST_1(N_Y)], wanted[AT_LEAST_1(N_U)];
    static Stage s;
    int i, changed = 0;
    memcpy(wanted, at->u, sizeof wanted);
    fix(wanted);
    for (i = 0; i < N_COMMANDS; i++) wanted[COMMANDS[i]] = commands[i];
    for (i = 0; i < N_U; i++) changed |= wanted[i] != at->u[i];
    if (changed) {
        memcpy(at->u, wanted, sizeof wanted);
        s.d = at->d; s.u = at->u; s.p = p; s.c = 0;
        history_at(&s, at->x, at->z);
        if (!settle(&s, at->x, at->z)) return 0;
        at->startup = STARTUP_STEPS;
    }
    return pgexcite_advance(RULE, PIECE_LENGTH[0], FIRST_COUNT, &at->startup, at->x, at->z, at->d, at->u, p, rows_x, rows_z, rows_d,
                            rows_y) == FIRST_COUNT;
}

static double largest(const double *a, int n) {
    double found = 0;
    int i;
    for (i = 0; i < n; i++)
        if (fabs(a[i]) > found) found = fabs(a[i]);
    return found;
}

/* Derivatives of all outputs to the first move. */
#define TO_MOVES(at) ((at)->G + N_X * N_SELECTED)
#define STRIDE (N_Q * N_SELECTED)

/* Whether the sample is the one that was prepared for. */
static int is_expected(const double *x, const double *p) {
    int i;
    if (!prepared) return 0;
    for (i = 0; i < N_P; i++)
        if (p[i] != prepared_p[i]) return 0;
    for (i = 0; i < N_X; i++)
        if (!(fabs(x[i] - prepared_x[i]) <= JUMP)) return 0;
    return 1;
}

/* One program around what was prepared, corrected for the state. */
static int feedback(const double *x, const double *u_last, const double *targets, double *found, double *cost) {
    static double y[HORIZON * N_SELECTED], step[N_V];
    double slope;
    int j, s, i;
    for (j = 0; j < HORIZON; j++)
        for (s = 0; s < N_SELECTED; s++) {
            double value = ready.y[j * N_SELECTED + s];
            for (i = 0; i < N_X; i++) value += ready.G[(j * N_Q + i) * N_SELECTED + s] * (x[i] - prepared_x[i]);
            y[j * N_SELECTED + s] = value;
        }
    if (!direction_of(y, TO_MOVES(&ready), STRIDE, targets, prepared_plan, u_last, step, &slope)) return ${NAME}_QP_FAILED;
    for (j = 0; j < HORIZON; j++)
        for (s = 0; s < N_SELECTED; s++)
            for (i = 0; i < N_V; i++) y[j * N_SELECTED + s] += TO_MOVES(&ready)[j * STRIDE + i * N_SELECTED + s] * step[i];
    for (i = 0; i < N_V; i++) found[i] = clipped(prepared_plan[i] + step[i], i);
    *cost = cost_of(y, targets, found, u_last);
    return ${NAME}_ITERATED;
}

/* Gauss-Newton with a line search on the true cost. */
static int iterate(const Point *at, const double *p, const double *u_last, const double *targets, int count, double *found,
                   double *cost, int *iterations) {
    static Prediction first, second;
    static double trial[N_V], step[N_V];
    Prediction *here = &first, *there = &second, *swap;
    double slope, length, scale, trial_cost = 0;
    int i, status = ${NAME}_ITERATED, known = 0, better;
    if (has_plan) {
        shift(plan, found);
        for (i = 0; i < N_V; i++) found[i] = clipped(found[i], i);
        known = predict(at, p, found, here);
    }
    if (!known) {
        for (i = 0; i < N_V; i++) found[i] = clipped(u_last[i % N_COMMANDS], i);
        if (!predict(at, p, found, here)) return ${NAME}_PREDICTION_FAILED;
    }
    *cost = cost_of(here->y, targets, found, u_last);
    for (*iterations = 0; *iterations < count;) {
        ++*iterations;
        if (!direction_of(here->y, TO_MOVES(here), STRIDE, targets, found, u_last, step, &slope))
            return *iterations == 1 ? ${NAME}_QP_FAILED : status;
        length = largest(step, N_V);
        if (length <= PLAN_TOLERANCE) return ${NAME}_CONVERGED;
        better = 0;
        for (scale = 1; !better && scale >= SHORTEST; scale /= 2) {
            for (i = 0; i < N_V; i++) trial[i] = clipped(found[i] + scale * step[i], i);
            if (!predict(at, p, trial, there)) continue;
            trial_cost = cost_of(there->y, targets, trial, u_last);
            better = trial_cost <= *cost + DECREASE * scale * (slope < 0 ? slope : 0);
        }
        if (!better) return length <= sqrt(PLAN_TOLERANCE) ? ${NAME}_CONVERGED : status;
        memcpy(found, trial, sizeof trial);
        *cost = trial_cost;
        swap = here; here = there; there = swap;
    }
    return status;
}
