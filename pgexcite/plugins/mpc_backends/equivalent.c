/* NMPC on an estimated equivalent, from the unit's terminals: the backend "equivalent" (pgexcite.plugins.mpc_backends.equivalent).

   Goes below shooting.c and an estimator. The equivalent's field voltage is OFFSET above the plant's: commands and bounds are the
   equivalent's inside, the plant's outside. */

/* The field voltage as seen in the last two samples, pu of the plant. */
static double field_before, field_seen;

/* Command, and whether in charge, in each sample since the last measurements. */
static double under_way[LATE + 1][2];

/* The equivalent's field voltage since the last sample, of which `field` was measured at the end. */
static double since_last(int whole, double field) {
    double first = field_before, before = field_seen;
    field_before = field_seen;
    field_seen = whole ? field : under_way[0][0];
    /* In charge it was constant. A regulator moved it: the mean of the parabola through the last three. */
    return (under_way[0][1] > 0 ? field_seen : (5 * field_seen + 8 * before - first) / 12) + OFFSET;
}

/* Keep what is in force until the next sample. */
static void send(const double *command) {
    if (fabs(command[0]) <= PLAUSIBLE) under_way[LATE][0] = command[0];
}

/* The equivalent at the estimate, carried on to the present under what was commanded since; 0 where its equations have no
   solution. */
static int locate(Point *at, double t, double *p) {
    static double u[AT_LEAST_1(N_U)];
    const double *bus = estimator_value + N_ROTOR + 3;
    int i;
    memcpy(at->x, X_0, sizeof(double) * N_X); memcpy(at->z, Z_0, sizeof(double) * N_Z);
    memcpy(at->d, D_0, sizeof(double) * N_D); memcpy(u, U_START, sizeof(double) * N_U); memcpy(p, P_0, sizeof(double) * N_P);
    for (i = 0; i < N_ROTOR; i++) at->x[ROTOR[i]] = estimator_value[i];
    at->x[AT_OMEGA] -= estimator_value[N_ROTOR + 1];
    at->x[AT_DELTA] = atan2(bus[0], bus[1]);
    u[AT_V_BUS] = hypot(bus[0], bus[1]);
    u[AT_P_M] = estimator_value[N_ROTOR];
    u[AT_E_FD] = field_seen + OFFSET;
    p[AT_X_S] = estimator_value[N_ROTOR + 2];
    if (!settle_at(at, u, p)) return 0;
    /* The last row is of the sample to come by now. */
    for (i = 0; i < LATE; i++) {
        double command = under_way[i][0] + OFFSET;
        if (!advance(at, t, p, &command)) return 0;
    }
    return all_finite(at->x, N_X) && all_finite(at->z, N_Z) && all_finite(at->u, N_U) && all_finite(p, N_P);
}

void ${name}_reset(void) {
    int i;
    has_plan = prepared = has_origin = 0;
    field_before = field_seen = FIELD_0;
    for (i = 0; i <= LATE; i++) {
        under_way[i][0] = FIELD_0;
        under_way[i][1] = 0;
    }
    ladder_reset();
    estimator_reset();
}

void ${name}_step(const ${name}_input *in, ${name}_output *out) {
    static double measured[N_MEASURED], p[AT_LEAST_1(N_P)], found[N_V];
    static Point at;
    double u_last = in->u_last[0] + OFFSET, command;
    int whole, sound;
    ladder_look(in->measured, measured);
    whole = all_finite(measured, N_MEASURED);
    sound = estimator_observe(whole ? measured : NULL, since_last(whole, measured[N_MEASURED - 1]));
    memmove(under_way, under_way[1], LATE * sizeof under_way[0]);
    if (LATE > 0) under_way[LATE][0] = under_way[LATE - 1][0];
    under_way[LATE][1] = in->active;
    if (DELAYED) send(in->u_last);
    has_origin = 0;
    out->iterations = 0;
    out->cost = INFINITY;
    out->status = ${NAME}_STATE_UNKNOWN;
    if (sound && all_finite(&in->t, 1) && all_finite(&u_last, 1) && locate(&at, in->t, p))
        out->status = plan_from(&at, in->t, p, &u_last, found, &out->cost, &out->iterations);
    if (out->status <= ${NAME}_ITERATED && ladder_is_stale()) out->status = ${NAME}_STALE;
    ladder_answer(in->active, &u_last, out->status <= ${NAME}_ITERATED, found, out);
    command = out->command[0] - OFFSET;
    out->command[0] = command < PLANT_LOWER ? PLANT_LOWER : command > PLANT_UPPER ? PLANT_UPPER : command;
    memcpy(out->estimate, estimator_told, sizeof out->estimate);
}

void ${name}_prepare(const double *command) {
    if (!DELAYED) send(command);
}
