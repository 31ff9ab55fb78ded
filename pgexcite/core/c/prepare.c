/* The real-time iteration's preparation. Goes below shooting.c. */

/* Linearises around the plan the next sample will start from, at the state expected then. */
static void prepare_from(const double *command) {
    static Horizon over;
    static double moved[N_V];
    prepared = 0;
    if (CONVERGE || !has_origin || !has_plan || !all_finite(command, N_COMMANDS)) return;
    has_origin = 0; /* the point is moved on in place */
    if (!advance(&origin, origin_t, origin_p, command)) return;
    shift(plan, moved);
    reach(moved, command, prepared_plan);
    horizon_at(origin_t + ENDS[0], origin.u, origin_p, FIRST_COUNT, &over);
    if (!predict(&origin, &over, prepared_plan, 1, &ready)) return;
    expected = origin;
    memcpy(prepared_p, origin_p, sizeof prepared_p);
    prepared = 1;
}
