/* Plans by shooting: the algorithm of pgexcite.core.plans_in_python. Goes below advance.c, chain.c, condensed.c and horizon.c.

   Expects N_SELECTED outputs, those of the program. */

/* Derivatives to the state come before those to the moves, where there are any. */
#define N_S (TRANSITION ? N_X : 0)
#define N_Q (N_S + N_V)

typedef struct {
    double y[HORIZON * N_SELECTED], G[HORIZON * N_Q * N_SELECTED];
} Prediction;

typedef struct {
    int startup;
    double x[AT_LEAST_1(N_X)], z[AT_LEAST_1(N_Z)], d[AT_LEAST_1(N_D)], u[AT_LEAST_1(N_U)];
} Point;

static double plan[N_V];
static int has_plan;

/* By how much the last iteration changed a command at the most. */
static double last_change;

/* What was prepared for the next sample, and the sample it is prepared from. */
static int prepared, has_origin;
static double prepared_plan[N_V], prepared_p[AT_LEAST_1(N_P)];
static Prediction ready;
static Point expected, origin;
static double origin_t, origin_p[AT_LEAST_1(N_P)];

static int differ(const double *a, const double *b, int n) {
    int i;
    for (i = 0; i < n; i++)
        if (a[i] != b[i]) return 1;
    return 0;
}

/* Derivatives of all outputs to the first move. */
#define TO_MOVES(at) ((at)->G + N_S * N_SELECTED)
#define STRIDE (N_Q * N_SELECTED)

static int predict(const Point *from, const Horizon *over, const double *moves, int derivatives, Prediction *to) {
    static double x[AT_LEAST_1(N_X)], z[AT_LEAST_1(N_Z)], d[AT_LEAST_1(N_D)];
    static double dy[HORIZON * N_COLUMNS * N_SELECTED], dx[HORIZON * N_COLUMNS * AT_LEAST_1(N_X)];
    static double X[2 * (N_X + N_V) * AT_LEAST_1(N_X)];
    int done;
    memcpy(x, from->x, sizeof x); memcpy(z, from->z, sizeof z); memcpy(d, from->d, sizeof d);
    if (derivatives) memset(dy, 0, sizeof dy);
    done = pgexcite_rollout(RULE, over->pieces, over->count, over->length, over->move, over->row, over->end, COMMANDS,
                            from->startup, x, z, d, over->p, over->u, moves, derivatives, to->y, dy, dx);
    if (done != over->pieces || !all_finite(to->y, HORIZON * N_SELECTED)) return 0;
    if (!derivatives) return 1;
    if (!all_finite(dy, HORIZON * N_COLUMNS * N_SELECTED)) return 0;
    if (TRANSITION)
        pgexcite_condense(HORIZON, N_MOVES, SAMPLE_MOVE, dy, dx, X, to->G);
    else
        memcpy(to->G, dy, sizeof to->G);
    return 1;
}

/* Solves the algebraic unknowns again under these commands. */
static int settle_at(Point *at, const double *u, const double *p) {
    static Stage s;
    memcpy(at->u, u, sizeof at->u);
    s.d = at->d; s.u = at->u; s.p = p;
    renewed(&s);
    at->startup = STARTUP_STEPS;
    return settle(&s, at->x, at->z);
}

static int step_on(Point *at, const double *p, double h, int count) {
    static double rows_x[SAMPLE_STEPS * AT_LEAST_1(N_X)], rows_z[SAMPLE_STEPS * AT_LEAST_1(N_Z)];
    static double rows_d[SAMPLE_STEPS * AT_LEAST_1(N_D)], rows_y[SAMPLE_STEPS * AT_LEAST_1(N_Y)];
    for (; count > 0; count -= SAMPLE_STEPS) {
        int n = count < SAMPLE_STEPS ? count : SAMPLE_STEPS;
        if (pgexcite_advance(RULE, h, n, &at->startup, at->x, at->z, at->d, at->u, p, rows_x, rows_z, rows_d, rows_y) != n) return 0;
    }
    return 1;
}

/* A piece's step, and the plant's own where it is that but for rounding: timers are expected to the last bit. */
static double on_grid(double length) { return fabs(length - GRID) < 1e-9 * GRID ? GRID : length; }

/* One sample in the plant's own steps under these commands, from t, with all that is known to happen by its end; p too is moved
   on. */
static int advance(Point *at, double t, double *p, const double *commands) {
    static Horizon over;
    static double wanted[AT_LEAST_1(N_U)];
    const double *row_p = over.p;
    int j = 0, i, row = -1;
    horizon_at(t, at->u, p, SAMPLE_STEPS, &over);
    do {
        if (over.row[j] != row) {
            int first = row < 0;
            row = over.row[j];
            row_p = over.p + row * N_P;
            memcpy(wanted, over.u + row * N_U, sizeof(double) * N_U);
            for (i = 0; i < N_COMMANDS; i++) wanted[COMMANDS[i]] = commands[i];
            if ((!first || differ(wanted, at->u, N_U)) && !settle_at(at, wanted, row_p)) return 0;
        }
        if (!step_on(at, row_p, on_grid(over.length[j]), over.count[j])) return 0;
    } while (!over.end[j++]);
    memcpy(wanted, over.u, sizeof(double) * N_U);
    between(t, t + ENDS[0], wanted, p);
    for (i = 0; i < N_COMMANDS; i++) wanted[COMMANDS[i]] = commands[i];
    return !(differ(p, row_p, N_P) || differ(wanted, at->u, N_U)) || settle_at(at, wanted, p);
}

/* The nearest plan that keeps the bounds on moves from u_last on, and those on commands. */
static void reach(const double *from, const double *u_last, double *to) {
    int i;
    for (i = 0; i < N_V; i++) {
        double before = i < N_COMMANDS ? u_last[i] : to[i - N_COMMANDS], move = from[i];
        if (move < before - DU_MAX[i]) move = before - DU_MAX[i];
        if (move > before + DU_MAX[i]) move = before + DU_MAX[i];
        to[i] = clipped(move, i);
    }
}

static double largest(const double *a, int n) {
    double found = 0;
    int i;
    for (i = 0; i < n; i++)
        if (fabs(a[i]) > found) found = fabs(a[i]);
    return found;
}

/* Whether the sample is the one that was prepared for. */
static int is_expected(const Point *at, const double *p) {
    int i;
    if (!prepared || differ(p, prepared_p, N_P) || differ(at->d, expected.d, N_D)) return 0;
    for (i = 0; i < N_OTHERS; i++)
        if (at->u[OTHERS[i]] != expected.u[OTHERS[i]]) return 0;
    for (i = 0; i < N_X; i++)
        if (!(fabs(at->x[i] - expected.x[i]) <= JUMP)) return 0;
    return 1;
}

/* The plan after a step that is taken on trust; its cost is to first order. y comes in before the step and goes out after it. */
static void take(const Prediction *at, const double *targets, const double *from, const double *step, const double *u_last, double *y,
                 double *found, double *cost) {
    int j, s, i;
    for (j = 0; j < HORIZON; j++)
        for (s = 0; s < N_SELECTED; s++)
            for (i = 0; i < N_V; i++) y[j * N_SELECTED + s] += TO_MOVES(at)[j * STRIDE + i * N_SELECTED + s] * step[i];
    for (i = 0; i < N_V; i++) found[i] = clipped(from[i] + step[i], i);
    *cost = cost_of(y, targets, found, u_last);
}

/* One program around what was prepared, corrected for the state. */
static int feedback(const double *x, const double *u_last, const double *targets, double *found, double *cost) {
    static double y[HORIZON * N_SELECTED], step[N_V];
    double slope;
    int j, s, i;
    for (j = 0; j < HORIZON; j++)
        for (s = 0; s < N_SELECTED; s++) {
            double value = ready.y[j * N_SELECTED + s];
            for (i = 0; i < N_S; i++) value += ready.G[(j * N_Q + i) * N_SELECTED + s] * (x[i] - expected.x[i]);
            y[j * N_SELECTED + s] = value;
        }
    if (!direction_of(y, TO_MOVES(&ready), STRIDE, targets, prepared_plan, u_last, step, &slope)) return ${NAME}_QP_FAILED;
    last_change = largest(step, N_V);
    take(&ready, targets, prepared_plan, step, u_last, y, found, cost);
    return ${NAME}_ITERATED;
}

/* The first plan that the model can be stepped through: the last one, the commands in force, as high or as low as can be. */
static int begin(const Point *at, const Horizon *over, const double *u_last, double *from, Prediction *to) {
    static double wanted[N_V];
    int k, i;
    for (k = has_plan ? 0 : 1; k < 4; k++) {
        if (k == 0)
            shift(plan, wanted);
        else
            for (i = 0; i < N_V; i++) wanted[i] = k == 1 ? u_last[i % N_COMMANDS] : k == 2 ? UPPER[i] : LOWER[i];
        reach(wanted, u_last, from);
        if (predict(at, over, from, 1, to)) return 1;
    }
    return 0;
}

/* Gauss-Newton with a line search on the true cost. A step of no more than `near`, and the last one where plans need not converge,
   is taken on trust. */
static int iterate(const Point *at, double t, const double *p, const double *u_last, const double *targets, int converge,
                   double *found, double *cost, int *iterations) {
    const int count = converge ? MAX_PLAN_ITERATIONS : JUMP_ITERATIONS;
    const double near = converge ? PLAN_TOLERANCE : JUMP_TOLERANCE;
    static Prediction first, second;
    static Horizon over;
    static double trial[N_V], step[N_V];
    Prediction *here = &first, *there = &second, *swap;
    double slope, length, scale, trial_cost = 0;
    int i, status = ${NAME}_ITERATED, better;
    horizon_at(t, at->u, p, FIRST_COUNT, &over);
    if (!begin(at, &over, u_last, found, here)) return ${NAME}_PREDICTION_FAILED;
    *cost = cost_of(here->y, targets, found, u_last);
    for (*iterations = 0; *iterations < count;) {
        ++*iterations;
        if (!direction_of(here->y, TO_MOVES(here), STRIDE, targets, found, u_last, step, &slope))
            return *iterations == 1 ? ${NAME}_QP_FAILED : status;
        length = last_change = largest(step, N_V);
        if (length <= PLAN_TOLERANCE) return ${NAME}_CONVERGED;
        if (length <= near || (!converge && *iterations == count)) {
            take(here, targets, found, step, u_last, here->y, found, cost);
            return status;
        }
        better = 0;
        for (scale = 1; !better && scale >= SHORTEST; scale /= 2) {
            for (i = 0; i < N_V; i++) trial[i] = clipped(found[i] + scale * step[i], i);
            if (!predict(at, &over, trial, *iterations < count, there)) continue;
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

/* A plan from this point on; found is a plan where the status says so. */
static int plan_from(const Point *at, double t, const double *p, const double *u_last, double *found, double *cost,
                     int *iterations) {
    static double targets[HORIZON * N_TRACKED];
    int status;
    origin = *at;
    memcpy(origin_p, p, sizeof origin_p);
    origin_t = t;
    has_origin = 0;
    if (DELAYED) {
        if (!advance(&origin, t, origin_p, u_last)) return ${NAME}_PREDICTION_FAILED;
        origin_t += ENDS[0];
    }
    has_origin = 1;
    references(origin_t, t, targets);
    if (!CONVERGE && is_expected(&origin, origin_p)) {
        *iterations = 1;
        status = feedback(origin.x, u_last, targets, found, cost);
    } else {
        status = iterate(&origin, origin_t, origin_p, u_last, targets, CONVERGE || !has_plan, found, cost, iterations);
    }
    if (status <= ${NAME}_ITERATED) {
        memcpy(plan, found, sizeof plan);
        has_plan = 1;
    }
    return status;
}
