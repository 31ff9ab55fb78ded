/* Nonlinear MPC from the plant's own state, by real-time iterations: the backend "nmpc". Goes below shooting.c. */

static int is_known(const ${name}_input *in) {
    return all_finite(&in->t, 1) && all_finite(in->x, N_X) && all_finite(in->z, N_Z) && all_finite(in->d, N_D) &&
           all_finite(in->u, N_U) && all_finite(in->p, N_P) && all_finite(in->u_last, N_COMMANDS);
}

static int make_plan(const ${name}_input *in, double *found, double *cost, int *iterations) {
    static double targets[HORIZON * N_TRACKED];
    int status, count = has_plan ? JUMP_ITERATIONS : MAX_PLAN_ITERATIONS;
    has_origin = 0;
    if (!is_known(in)) return ${NAME}_STATE_UNKNOWN;
    origin.startup = in->startup;
    memcpy(origin.x, in->x, sizeof origin.x); memcpy(origin.z, in->z, sizeof origin.z);
    memcpy(origin.d, in->d, sizeof origin.d); memcpy(origin.u, in->u, sizeof origin.u);
    memcpy(origin_p, in->p, sizeof origin_p);
    has_origin = 1;
    references(in->t, in->t, targets);
    if (is_expected(in->x, in->p)) {
        *iterations = 1;
        status = feedback(in->x, in->u_last, targets, found, cost);
    } else {
        status = iterate(&origin, in->p, in->u_last, targets, count, found, cost, iterations);
    }
    if (status == ${NAME}_CONVERGED || status == ${NAME}_ITERATED) {
        memcpy(plan, found, sizeof plan);
        has_plan = 1;
    }
    return status;
}

void ${name}_reset(void) {
    has_plan = prepared = has_origin = 0;
    ladder_reset();
}

void ${name}_step(const ${name}_input *in, ${name}_output *out) {
    static double found[N_V];
    out->iterations = 0;
    out->cost = INFINITY;
    out->status = make_plan(in, found, &out->cost, &out->iterations);
    ladder_answer(in->active, in->u_last, out->status <= ${NAME}_ITERATED, found, out);
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
