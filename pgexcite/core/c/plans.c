/* Plans for Python: what pgexcite.core.plans_in_c calls. Goes below prepare.c. */

/* A plan from the state that these arrays hold: its status; what was found, its cost and largest change in the last iteration. */
PGEXCITE_PUBLIC int pgexcite_plan(double t, int startup, const double *x, const double *z, const double *d, const double *u,
                                  const double *p, const double *u_last, double *found, double *cost_and_change, int *iterations) {
    static Point at;
    int status;
    at.startup = startup;
    memcpy(at.x, x, sizeof(double) * N_X); memcpy(at.z, z, sizeof(double) * N_Z);
    memcpy(at.d, d, sizeof(double) * N_D); memcpy(at.u, u, sizeof(double) * N_U);
    last_change = INFINITY;
    cost_and_change[0] = INFINITY;
    *iterations = 0;
    status = plan_from(&at, t, p, u_last, found, cost_and_change, iterations);
    cost_and_change[1] = last_change;
    return status;
}

/* There is no state at this sample: nothing can be prepared for the next. */
PGEXCITE_PUBLIC void pgexcite_lost(void) { has_origin = 0; }

/* Linearises around the plan the next sample will start from, at the state expected then. */
PGEXCITE_PUBLIC void pgexcite_prepare(const double *command) { prepare_from(command); }

/* What is remembered between samples: read into these arrays, or taken from them; bit 0 of what there is stands for a plan, bit 1
   for a linearisation. */
PGEXCITE_PUBLIC int pgexcite_remember(int take, int there, double *plans, double *x, double *d, double *u, double *p, double *y,
                                      double *G) {
    double *kept[] = {plan, prepared_plan, expected.x, expected.d, expected.u, prepared_p, ready.y, ready.G};
    double *given[] = {plans, plans + N_V, x, d, u, p, y, G};
    const size_t sizes[] = {N_V, N_V, N_X, N_D, N_U, N_P, HORIZON * N_SELECTED, HORIZON * N_Q * N_SELECTED};
    int k;
    if (take) {
        has_plan = there & 1; prepared = there >> 1;
        has_origin = 0;
    }
    for (k = 0; k < 8; k++) memcpy(take ? kept[k] : given[k], take ? given[k] : kept[k], sizeof(double) * sizes[k]);
    return has_plan + 2 * prepared;
}
