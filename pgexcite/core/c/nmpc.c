/* Nonlinear MPC from the plant's own state: the backend "nmpc". Goes below prepare.c. */

static int is_known(const ${name}_input *in) {
    return all_finite(&in->t, 1) && all_finite(in->x, N_X) && all_finite(in->z, N_Z) && all_finite(in->d, N_D) &&
           all_finite(in->u, N_U) && all_finite(in->p, N_P) && all_finite(in->u_last, N_COMMANDS);
}

static int make_plan(const ${name}_input *in, double *found, double *cost, int *iterations) {
    static Point at;
    has_origin = 0;
    if (!is_known(in)) return ${NAME}_STATE_UNKNOWN;
    at.startup = in->startup;
    memcpy(at.x, in->x, sizeof at.x); memcpy(at.z, in->z, sizeof at.z);
    memcpy(at.d, in->d, sizeof at.d); memcpy(at.u, in->u, sizeof at.u);
    return plan_from(&at, in->t, in->p, in->u_last, found, cost, iterations);
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

/* Work for the next sample. */
void ${name}_prepare(const double *command) { prepare_from(command); }
