/* Linear MPC with a Kalman filter on states and disturbances: the backend "linear". Goes below offset_free.c. */

static double plan[N_V], since_t;
static int has_plan, has_since, age;

/* Commands, and whether in charge, in each sample since the measurements of the sample before this one. */
static struct { double u[N_COMMANDS]; int active; } under_way[LATE + 1];

/* From the initial point. */
static void forget(void) {
    int i, k;
    filter_reset();
    move_point(POINT_X, POINT_U);
    for (k = 0; k <= LATE; k++) {
        under_way[k].active = 0;
        for (i = 0; i < N_COMMANDS; i++) under_way[k].u[i] = POINT_U[i] + U_BIAS[i];
    }
    has_plan = has_since = age = 0;
}

/* When the measurements told at t were taken. */
static double taken_at(double t) { return t - LATE * DT; }

/* Predicts to the instant of what was measured and corrects by it; whether the state is known there. */
static int observe(double t, const double *measured, const double *u_last) {
    static Transition step;
    static double u[N_COMMANDS], push[AT_LEAST_1(N_X)], seen[N_SEEN];
    const double *y = Y_0, *to_y = TO_Y_0;
    int i;
    if (has_since) {
        /* On standby the command moves between two samples, and is measured as late as all else: both ends are known. */
        for (i = 0; i < N_COMMANDS; i++)
            u[i] = (under_way[0].active ? under_way[0].u[i] : (under_way[LATE].u[i] + u_last[i]) / 2) - U_BIAS[i];
        push_of(push);
        if (!first_sample(taken_at(since_t), mean, u, push, &step)) return 0;
        filter_predict(&step);
        /* Measured after what is known to have changed at this instant; without it the change would count twice. */
        if (changes_at(taken_at(t))) outputs_at(taken_at(t), u, &step);
        y = step.y;
        to_y = step.to_y;
    }
    for (i = 0; i < N_SEEN; i++) seen[i] = measured[SEEN_AT[i]];
    if (filter_correct(seen, y, to_y) && is_sound()) return 1;
    forget();
    return 0;
}

/* Moves the point of linearisation to the estimate, where it is time. */
static void relinearise(const double *u_last) {
    static double u[N_COMMANDS];
    int i;
    if (!RELINEARISE_EVERY || ++age < RELINEARISE_EVERY) return;
    age = 0;
    for (i = 0; i < N_COMMANDS; i++) u[i] = u_last[i] - U_BIAS[i];
    move_point(mean, u);
}

/* Prediction around a plan, of outputs as the plant has them. */
static int prediction(double t, const double *u_last, const double *around, double *y, double *G) {
    static Transition step;
    static double push[AT_LEAST_1(N_X)], u[N_COMMANDS], moves[N_V];
    const double *x = mean;
    int i, j, k;
    push_of(push);
    t = taken_at(t);
    for (k = 1; k <= LATE + DELAYED; k++) {
        const double *since = k <= LATE ? under_way[k].u : u_last;
        for (i = 0; i < N_COMMANDS; i++) u[i] = since[i] - U_BIAS[i];
        if (!first_sample(t, x, u, push, &step)) return 0;
        x = step.x;
        t += DT;
    }
    for (i = 0; i < N_V; i++) moves[i] = around[i] - U_BIAS[i % N_COMMANDS];
    if (!predict_linear(t, x, moves, push, y, G)) return 0;
    for (j = 0; j < HORIZON; j++)
        for (i = 0; i < N_OUTPUTS; i++) y[j * N_OUTPUTS + i] += Y_BIAS[PREDICTED[i]] + shift_of(PREDICTED[i]);
    return 1;
}

static int any(const double *a, long n) {
    long i;
    for (i = 0; i < n; i++)
        if (a[i] != 0) return 1;
    return 0;
}

static int make_plan(double t, const double *u_last, double *cost) {
    static double y[HORIZON * N_OUTPUTS], before[HORIZON * N_OUTPUTS], G[HORIZON * N_V * N_OUTPUTS], targets[HORIZON * N_TRACKED], around[N_V], step[N_V];
    double slope, start = DELAYED ? t + DT : t;
    int i, j, s, known;
    keep(u_last, around);
    if (has_plan) shift(plan, around);
    for (i = 0; i < N_V; i++) around[i] = clipped(around[i], i);
    known = prediction(t, u_last, around, y, G);
    if (!known) {
        /* The model cannot be stepped from the estimate: the initial point still serves. */
        move_point(POINT_X, POINT_U);
        known = prediction(t, u_last, around, y, G);
    } else if (!any(G, (long)HORIZON * N_V * N_OUTPUTS)) {
        /* A limit of the model is met, where commands have no effect: around the initial commands they have. */
        memcpy(before, y, sizeof before);
        move_point(mean, POINT_U);
        if (!prediction(t, u_last, around, y, G)) {
            memcpy(y, before, sizeof before);
            memset(G, 0, sizeof G);
        }
    }
    if (!known) return ${NAME}_PREDICTION_FAILED;
    references(start, t, targets);
    if (!direction_of(y, G, N_V * N_OUTPUTS, targets, around, u_last, step, &slope)) return ${NAME}_QP_FAILED;
    for (i = 0; i < N_V; i++) plan[i] = clipped(around[i] + step[i], i);
    has_plan = 1;
    for (j = 0; j < HORIZON; j++)
        for (s = 0; s < N_OUTPUTS; s++)
            for (i = 0; i < N_V; i++) y[j * N_OUTPUTS + s] += G[((long)j * N_V + i) * N_OUTPUTS + s] * step[i];
    *cost = cost_of(y, targets, plan, u_last);
    return ${NAME}_CONVERGED;
}

void ${name}_reset(void) {
    forget();
    ladder_reset();
}

void ${name}_step(const ${name}_input *in, ${name}_output *out) {
    static double measured[N_MEASURED], u_last[N_COMMANDS];
    int i;
    for (i = 0; i < N_COMMANDS; i++) u_last[i] = all_finite(in->u_last + i, 1) ? in->u_last[i] : under_way[LATE].u[i];
    ladder_look(in->measured, measured);
    out->iterations = 0;
    out->cost = INFINITY;
    out->status = ${NAME}_STATE_UNKNOWN;
    if (!all_finite(&in->t, 1)) {
        has_since = 0;
    } else {
        if (observe(in->t, measured, u_last)) {
            relinearise(u_last);
            out->status = make_plan(in->t, u_last, &out->cost);
            out->iterations = out->status == ${NAME}_CONVERGED;
        }
        has_since = 1;
        since_t = in->t;
    }
    memmove(under_way, under_way + 1, LATE * sizeof under_way[0]);
    memcpy(under_way[LATE].u, u_last, sizeof u_last);
    under_way[LATE].active = in->active;
    for (i = N_X; i < N_MEAN; i++) out->estimate[i - N_X] = mean[i];
    out->estimate[N_MEAN - N_X] = surprise;
    if (out->status <= ${NAME}_ITERATED && ladder_is_stale()) out->status = ${NAME}_STALE;
    ladder_answer(in->active, in->u_last, out->status <= ${NAME}_ITERATED, plan, out);
}

void ${name}_prepare(const double *command) {
    if (!DELAYED && all_finite(command, N_COMMANDS)) memcpy(under_way[LATE].u, command, sizeof under_way[LATE].u);
}
