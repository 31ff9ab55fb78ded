/* Real-time iterations: the algorithm of pgexcite.core.shooting and pgexcite.core.condensed, and the checks of
   pgexcite.core.ladder. Goes below step.c, rollout.c and qp.c. */

#include <math.h>

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

static double ladder_plan[N_V];
static int reused, has_ladder_plan;

/* What was prepared for the next sample, and the sample it is prepared from. */
static int prepared, has_origin;
static double prepared_plan[N_V], prepared_x[AT_LEAST_1(N_X)], prepared_p[AT_LEAST_1(N_P)];
static Prediction ready;
static Point origin;
static double origin_t, origin_p[AT_LEAST_1(N_P)];

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

static void shift(const double *from, double *to) {
    int k, i;
    for (k = 0; k < N_MOVES; k++)
        for (i = 0; i < N_COMMANDS; i++) to[k * N_COMMANDS + i] = from[SHIFTED[k] * N_COMMANDS + i];
}

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

static void references(double t, double *to) {
    int j, i, k;
    for (j = 0; j < HORIZON; j++)
        for (i = 0; i < N_SELECTED; i++) {
            double value = i < N_VOLTAGES ? V_REF[i] : 1;
            if (i < N_VOLTAGES)
                for (k = 0; k < N_PREVIEWS; k++)
                    if (PREVIEW_T[k] <= t + ENDS[j] + 1e-9) value = PREVIEW_V[k * N_VOLTAGES + i];
            to[j * N_SELECTED + i] = value;
        }
}

static void moves_of(const double *of, const double *u_last, double *moves) {
    int i;
    for (i = 0; i < N_V; i++) moves[i] = of[i] - (i < N_COMMANDS ? u_last[i] : of[i - N_COMMANDS]);
}

static double cost_of(const double *y, const double *targets, const double *of, const double *u_last) {
    double total = 0, moves[N_V];
    int i;
    for (i = 0; i < HORIZON * N_SELECTED; i++) total += WEIGHTS[i] * (y[i] - targets[i]) * (y[i] - targets[i]);
    moves_of(of, u_last, moves);
    for (i = 0; i < N_V; i++) total += R[i] * moves[i] * moves[i];
    return total;
}

/* Derivative of output s of sample j to move i. */
#define TO_MOVE(at, j, i, s) ((at)->G[((j) * N_Q + N_X + (i)) * N_SELECTED + (s)])
#define TO_STATE(at, j, i, s) ((at)->G[((j) * N_Q + (i)) * N_SELECTED + (s)])

/* The Gauss-Newton step from a plan, and its slope of the cost. */
static int direction_of(const double *y, const Prediction *at, const double *targets, const double *from, const double *u_last,
                        double *step, double *slope) {
    static double H[N_V * N_V], g[N_V], lower[N_V], upper[N_V], row_lower[N_V], row_upper[N_V], moves[N_V];
    int j, i, k, s;
    memset(H, 0, sizeof H); memset(g, 0, sizeof g);
    for (j = 0; j < HORIZON; j++)
        for (s = 0; s < N_SELECTED; s++) {
            double weight = 2 * WEIGHTS[j * N_SELECTED + s], error = y[j * N_SELECTED + s] - targets[j * N_SELECTED + s];
            for (i = 0; i < N_V; i++) {
                double weighted = weight * TO_MOVE(at, j, i, s);
                if (weighted == 0) continue;
                g[i] += weighted * error;
                for (k = 0; k <= i; k++) H[i * N_V + k] += weighted * TO_MOVE(at, j, k, s);
            }
        }
    moves_of(from, u_last, moves);
    for (i = 0; i < N_V; i++) {
        H[i * N_V + i] += 2 * R[i];
        g[i] += 2 * R[i] * moves[i];
        if (i >= N_COMMANDS) {
            H[(i - N_COMMANDS) * N_V + i - N_COMMANDS] += 2 * R[i];
            H[i * N_V + i - N_COMMANDS] -= 2 * R[i];
            g[i - N_COMMANDS] -= 2 * R[i] * moves[i];
        }
        lower[i] = LOWER[i] - from[i];
        upper[i] = UPPER[i] - from[i];
        row_lower[i] = -DU_MAX[i] - moves[i];
        row_upper[i] = DU_MAX[i] - moves[i];
    }
    for (i = 0; i < N_V; i++)
        for (k = i + 1; k < N_V; k++) H[i * N_V + k] = H[k * N_V + i];
    if (!qp_solve(H, g, lower, upper, row_lower, row_upper, step)) return 0;
    *slope = 0;
    for (i = 0; i < N_V; i++) *slope += g[i] * step[i];
    return 1;
}

static double largest(const double *a, int n) {
    double found = 0;
    int i;
    for (i = 0; i < n; i++)
        if (fabs(a[i]) > found) found = fabs(a[i]);
    return found;
}

/* Whether the sample is the one that was prepared for. */
static int is_expected(const ${name}_input *in) {
    int i;
    if (!prepared) return 0;
    for (i = 0; i < N_P; i++)
        if (in->p[i] != prepared_p[i]) return 0;
    for (i = 0; i < N_X; i++)
        if (!(fabs(in->x[i] - prepared_x[i]) <= JUMP)) return 0;
    return 1;
}

/* One program around what was prepared, corrected for the state. */
static int feedback(const ${name}_input *in, const double *targets, double *found, double *cost) {
    static double y[HORIZON * N_SELECTED], step[N_V];
    double slope;
    int j, s, i;
    for (j = 0; j < HORIZON; j++)
        for (s = 0; s < N_SELECTED; s++) {
            double value = ready.y[j * N_SELECTED + s];
            for (i = 0; i < N_X; i++) value += TO_STATE(&ready, j, i, s) * (in->x[i] - prepared_x[i]);
            y[j * N_SELECTED + s] = value;
        }
    if (!direction_of(y, &ready, targets, prepared_plan, in->u_last, step, &slope)) return ${NAME}_QP_FAILED;
    for (j = 0; j < HORIZON; j++)
        for (s = 0; s < N_SELECTED; s++)
            for (i = 0; i < N_V; i++) y[j * N_SELECTED + s] += TO_MOVE(&ready, j, i, s) * step[i];
    for (i = 0; i < N_V; i++) found[i] = clipped(prepared_plan[i] + step[i], i);
    *cost = cost_of(y, targets, found, in->u_last);
    return ${NAME}_ITERATED;
}

/* Gauss-Newton with a line search on the true cost. */
static int iterate(const ${name}_input *in, const Point *at, const double *targets, int count, double *found, double *cost,
                   int *iterations) {
    static Prediction first, second;
    static double hold[N_V], trial[N_V], step[N_V];
    Prediction *here = &first, *there = &second, *swap;
    double slope, length, scale, trial_cost = 0;
    int i, status = ${NAME}_ITERATED, known = 0, better;
    for (i = 0; i < N_V; i++) hold[i] = clipped(in->u_last[i % N_COMMANDS], i);
    if (has_plan) {
        shift(plan, found);
        for (i = 0; i < N_V; i++) found[i] = clipped(found[i], i);
        known = predict(at, in->p, found, here);
    }
    if (!known) {
        memcpy(found, hold, sizeof hold);
        if (!predict(at, in->p, found, here)) return ${NAME}_PREDICTION_FAILED;
    }
    *cost = cost_of(here->y, targets, found, in->u_last);
    for (*iterations = 0; *iterations < count;) {
        ++*iterations;
        if (!direction_of(here->y, here, targets, found, in->u_last, step, &slope))
            return *iterations == 1 ? ${NAME}_QP_FAILED : status;
        length = largest(step, N_V);
        if (length <= PLAN_TOLERANCE) return ${NAME}_CONVERGED;
        better = 0;
        for (scale = 1; !better && scale >= SHORTEST; scale /= 2) {
            for (i = 0; i < N_V; i++) trial[i] = clipped(found[i] + scale * step[i], i);
            if (!predict(at, in->p, trial, there)) continue;
            trial_cost = cost_of(there->y, targets, trial, in->u_last);
            better = trial_cost <= *cost + DECREASE * scale * (slope < 0 ? slope : 0);
        }
        if (!better) return length <= sqrt(PLAN_TOLERANCE) ? ${NAME}_CONVERGED : status;
        memcpy(found, trial, sizeof trial);
        *cost = trial_cost;
        swap = here; here = there; there = swap;
    }
    return status;
}

static int is_known(const ${name}_input *in) {
    return all_finite(&in->t, 1) && all_finite(in->x, N_X) && all_finite(in->z, N_Z) && all_finite(in->d, N_D) &&
           all_finite(in->u, N_U) && all_finite(in->p, N_P) && all_finite(in->u_last, N_COMMANDS);
}

static int make_plan(const ${name}_input *in, double *found, double *cost, int *iterations) {
    static double targets[HORIZON * N_SELECTED];
    int status, count = has_plan ? JUMP_ITERATIONS : MAX_PLAN_ITERATIONS;
    has_origin = 0;
    if (!is_known(in)) return ${NAME}_STATE_UNKNOWN;
    origin.startup = in->startup;
    memcpy(origin.x, in->x, sizeof origin.x); memcpy(origin.z, in->z, sizeof origin.z);
    memcpy(origin.d, in->d, sizeof origin.d); memcpy(origin.u, in->u, sizeof origin.u);
    memcpy(origin_p, in->p, sizeof origin_p);
    origin_t = in->t;
    has_origin = 1;
    references(in->t, targets);
    if (is_expected(in)) {
        *iterations = 1;
        status = feedback(in, targets, found, cost);
    } else {
        status = iterate(in, &origin, targets, count, found, cost, iterations);
    }
    if (status == ${NAME}_CONVERGED || status == ${NAME}_ITERATED) {
        memcpy(plan, found, sizeof plan);
        has_plan = 1;
    }
    return status;
}

void ${name}_reset(void) {
    has_plan = has_ladder_plan = prepared = has_origin = reused = 0;
}

void ${name}_step(const ${name}_input *in, ${name}_output *out) {
    static double found[N_V], shifted[N_V];
    double last;
    int i, good;
    out->iterations = 0;
    out->cost = INFINITY;
    out->status = make_plan(in, found, &out->cost, &out->iterations);
    good = (out->status == ${NAME}_CONVERGED || out->status == ${NAME}_ITERATED) && all_finite(found, N_V) && all_finite(&out->cost, 1);
    for (i = 0; good && i < N_V; i++) good = found[i] >= LOWER[i] - 1e-9 && found[i] <= UPPER[i] + 1e-9;
    if (good) {
        memcpy(ladder_plan, found, sizeof found);
        has_ladder_plan = 1;
        reused = 0;
        out->level = 0;
    } else if (has_ladder_plan && reused < MAX_REUSE) {
        shift(ladder_plan, shifted);
        memcpy(ladder_plan, shifted, sizeof shifted);
        reused++;
        out->level = 1;
    } else {
        out->level = 2;
    }
    for (i = 0; i < N_COMMANDS; i++) {
        last = all_finite(in->u_last + i, 1) ? in->u_last[i] : has_ladder_plan ? ladder_plan[i] : U_0[i];
        out->command[i] = clipped(out->level < 2 ? ladder_plan[i] : last, i);
    }
}

void ${name}_prepare(const double *command) {
    int i;
    prepared = 0;
    if (!has_origin || !has_plan || !all_finite(command, N_COMMANDS)) return;
    has_origin = 0; /* the point is moved on in place */
    if (!advance(&origin, origin_p, command)) return;
    shift(plan, prepared_plan);
    for (i = 0; i < N_V; i++) prepared_plan[i] = clipped(prepared_plan[i], i);
    if (!predict(&origin, origin_p, prepared_plan, &ready)) return;
    memcpy(prepared_x, origin.x, sizeof prepared_x);
    memcpy(prepared_p, origin_p, sizeof prepared_p);
    prepared = 1;
}
