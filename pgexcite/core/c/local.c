/* Linear predictions around one point of a model: the algorithm of pgexcite.core.local. Goes below rollout.c, condensed.c and horizon.c.

   Expects N_KEPT, how many transitions are kept, and set-points and parameters at the start of the run (U_START, P_START). */

/* Consecutive steps linearised: where they end, and derivatives to the states at the beginning and to the commands; those of the
   outputs to the states at the end. One array after the other for each of them. */
typedef struct {
    int there, count, changes;
    double h, x[AT_LEAST_1(N_X)], y[N_SELECTED], to_x[N_COLUMNS * AT_LEAST_1(N_X)], to_y[N_COLUMNS * N_SELECTED];
} Transition;

static double point_x[AT_LEAST_1(N_X)], point_u[N_COMMANDS];
static Transition kept[N_KEPT];
static int n_kept, oldest;

/* The horizon now, and how many known changes are in force at its beginning. */
static Horizon over;
static int changes;

/* Set-points and parameters in force at t, as far as changes are known. */
static void in_force(double t, double *u, double *p) {
    memcpy(u, U_START, sizeof(double) * N_U); memcpy(p, P_START, sizeof(double) * N_P);
    fix(u);
    between(-INFINITY, t, u, p);
}

static int changes_at(double t) {
    int k;
    for (k = 0; k < N_KNOWN; k++)
        if (fabs(KNOWN_T[k] - t) <= SAME_INSTANT) return 1;
    return 0;
}

static void begin_horizon(double t) {
    static double u[AT_LEAST_1(N_U)], p[AT_LEAST_1(N_P)];
    in_force(t, u, p);
    horizon_at(t, u, p, FIRST_COUNT, &over);
    for (changes = 0; changes < N_KNOWN && KNOWN_T[changes] <= t + SAME_INSTANT;) changes++;
}

/* Linearise at other states and commands from now on. */
static void move_point(const double *x, const double *u) {
    memcpy(point_x, x, sizeof(double) * N_X);
    memcpy(point_u, u, sizeof point_u);
    n_kept = oldest = 0;
}

/* Outputs at a point and their derivatives to states and commands. */
static void outputs_of(const double *x, const double *z, const double *d, const double *u, const double *p, double *y,
                       double *to_y) {
    static Stage s;
    s.d = d; s.u = u; s.p = p;
    renewed(&s);
    aim(&s, FROZEN);
    memset(S, 0, sizeof S); memset(S_c, 0, sizeof S_c);
    point_at(0, 1);
    sense_settling(&s, x, z);
    sense_outputs(&s, x, z, y, to_y);
}

/* To the point, with other set-points and parameters in force: its algebraic unknowns are solved again. */
static int go_to_point(const double *wanted, const double *p, double *x, double *z, double *d, double *u) {
    static Stage s;
    int i;
    memcpy(x, point_x, sizeof point_x); memcpy(z, POINT_Z, sizeof(double) * N_Z); memcpy(d, POINT_D, sizeof(double) * N_D);
    memcpy(u, wanted, sizeof(double) * N_U);
    for (i = 0; i < N_COMMANDS; i++) u[COMMANDS[i]] = point_u[i];
    s.d = d; s.u = u; s.p = p;
    renewed(&s);
    return settle(&s, x, z);
}

/* Steps from the point; 0 where they cannot be taken. */
static int linearise(int count, double h, const double *wanted, const double *p, Transition *to) {
    static double z[AT_LEAST_1(N_Z)], d[AT_LEAST_1(N_D)], u[AT_LEAST_1(N_U)], y[N_SELECTED], dy[N_COLUMNS * N_SELECTED];
    static const int first = 0, ends = 1;
    if (!go_to_point(wanted, p, to->x, z, d, u)) return 0;
    if (pgexcite_rollout(RULE, 1, &count, &h, &first, &first, &ends, COMMANDS, STARTUP_STEPS, to->x, z, d, p, u, point_u, 1, y, dy,
                         to->to_x) != 1)
        return 0;
    outputs_of(to->x, z, d, u, p, to->y, to->to_y);
    return all_finite(to->to_x, N_COLUMNS * N_X) && all_finite(to->to_y, N_X * N_SELECTED);
}

/* The transition of a piece of the horizon, made once at each point. */
static const Transition *transition_of(int piece) {
    int count = over.count[piece], row = over.row[piece], k;
    /* Lengths are differences of times: without rounding no two of them were the same. */
    double h = floor(over.length[piece] * 1e12 + 0.5) / 1e12;
    Transition *to;
    for (k = 0; k < n_kept; k++)
        if (kept[k].count == count && kept[k].h == h && kept[k].changes == changes + row) return kept[k].there ? kept + k : NULL;
    if (n_kept < N_KEPT) {
        to = kept + n_kept++;
    } else {
        to = kept + oldest;
        oldest = (oldest + 1) % N_KEPT;
    }
    to->count = count;
    to->h = h;
    to->changes = changes + row;
    to->there = linearise(count, h, over.u + (long)row * N_U, over.p + (long)row * N_P, to);
    return to->there ? to : NULL;
}

/* to = steps from x under commands that are du from those of the point. */
static void step_linear(const Transition *by, const double *x, const double *du, double *to) {
    static double dx[AT_LEAST_1(N_X)];
    int i, q;
    for (i = 0; i < N_X; i++) dx[i] = x[i] - point_x[i];
    for (i = 0; i < N_X; i++) {
        double sum = by->x[i];
        for (q = 0; q < N_X; q++) sum += by->to_x[q * N_X + i] * dx[q];
        for (q = 0; q < N_COMMANDS; q++) sum += by->to_x[(N_X + q) * N_X + i] * du[q];
        to[i] = sum;
    }
}

static double output_linear(const Transition *at, int s, const double *x, const double *du) {
    double sum = at->y[s];
    int q;
    for (q = 0; q < N_X; q++) sum += at->to_y[q * N_SELECTED + s] * (x[q] - at->x[q]);
    for (q = 0; q < N_COMMANDS; q++) sum += at->to_y[(N_X + q) * N_SELECTED + s] * du[q];
    return sum;
}

/* columns (n_x numbers each, n of them): each goes through the states' derivatives. */
static void carry(const Transition *by, double *columns, int n) {
    static double from[AT_LEAST_1(N_X)];
    int c, i, q;
    for (c = 0; c < n; c++) {
        double *to = columns + (long)c * N_X;
        memcpy(from, to, sizeof from);
        memset(to, 0, sizeof from);
        for (q = 0; q < N_X; q++)
            if (from[q] != 0)
                for (i = 0; i < N_X; i++) to[i] += by->to_x[q * N_X + i] * from[q];
    }
}

/* The first sample from t on, from x under commands u; push moves the states at its end. */
static int first_sample(double t, const double *x, const double *u, const double *push, Transition *to) {
    static double du[N_COMMANDS], next[AT_LEAST_1(N_X)];
    const Transition *step = NULL;
    int k, i;
    begin_horizon(t);
    for (i = 0; i < N_COMMANDS; i++) du[i] = u[i] - point_u[i];
    for (k = 0; k == 0 || !over.end[k - 1]; k++) {
        if ((step = transition_of(k)) == NULL) return 0;
        step_linear(step, k == 0 ? x : to->x, du, next);
        memcpy(to->x, next, sizeof next);
        if (k == 0) {
            memcpy(to->to_x, step->to_x, sizeof to->to_x);
        } else {
            carry(step, to->to_x, N_COLUMNS);
            for (i = 0; i < N_COMMANDS * N_X; i++) to->to_x[N_X * N_X + i] += step->to_x[N_X * N_X + i];
        }
    }
    for (i = 0; i < N_X; i++) to->x[i] += push[i];
    for (i = 0; i < N_SELECTED; i++) to->y[i] = output_linear(step, i, to->x, du);
    memcpy(to->to_y, step->to_y, sizeof to->to_y);
    return 1;
}

/* Outputs at these states under commands u, with what is in force at t, and their derivatives; to has the states. */
static int outputs_at(double t, const double *u, Transition *to) {
    static Transition here;
    static double z[AT_LEAST_1(N_Z)], d[AT_LEAST_1(N_D)], all[AT_LEAST_1(N_U)], others[AT_LEAST_1(N_U)], p[AT_LEAST_1(N_P)], du[N_COMMANDS];
    int i;
    in_force(t, others, p);
    if (!go_to_point(others, p, here.x, z, d, all)) return 0;
    outputs_of(here.x, z, d, all, p, here.y, here.to_y);
    for (i = 0; i < N_COMMANDS; i++) du[i] = u[i] - point_u[i];
    for (i = 0; i < N_SELECTED; i++) to->y[i] = output_linear(&here, i, to->x, du);
    memcpy(to->to_y, here.to_y, sizeof to->to_y);
    return 1;
}

/* Outputs of the program at the end of each sample from t on and their derivatives to the moves; push moves the states in each
   sample of the first interval's length. */
static int predict_linear(double t, const double *from, const double *moves, const double *push, double *y, double *G) {
    static double x[AT_LEAST_1(N_X)], next[AT_LEAST_1(N_X)], du[N_COMMANDS], slopes[N_V * AT_LEAST_1(N_X)];
    double dt = 0;
    int k, i, c, q, s, sample = 0;
    begin_horizon(t);
    memcpy(x, from, sizeof(double) * N_X);
    memset(slopes, 0, sizeof slopes);
    for (k = 0; k == 0 || !over.end[k - 1]; k++) dt += over.count[k] * over.length[k];
    for (k = 0; k < over.pieces; k++) {
        int own = over.move[k] * N_COMMANDS;
        const Transition *step = transition_of(k);
        if (step == NULL) return 0;
        for (i = 0; i < N_COMMANDS; i++) du[i] = moves[own + i] - point_u[i];
        step_linear(step, x, du, next);
        for (i = 0; i < N_X; i++) x[i] = next[i] + over.count[k] * over.length[k] / dt * push[i];
        carry(step, slopes, N_V);
        for (i = 0; i < N_COMMANDS * N_X; i++) slopes[own * N_X + i] += step->to_x[N_X * N_X + i];
        if (!over.end[k]) continue;
        for (s = 0; s < N_OUTPUTS; s++) {
            int row = PREDICTED[s];
            y[sample * N_OUTPUTS + s] = output_linear(step, row, x, du);
            for (c = 0; c < N_V; c++) {
                double sum = c >= own && c < own + N_COMMANDS ? step->to_y[(N_X + c - own) * N_SELECTED + row] : 0;
                for (q = 0; q < N_X; q++) sum += step->to_y[q * N_SELECTED + row] * slopes[c * N_X + q];
                G[((long)sample * N_V + c) * N_OUTPUTS + s] = sum;
            }
        }
        sample++;
    }
    return 1;
}
