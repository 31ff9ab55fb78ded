/* What reaches the plant: this plan, an old one, or the last command; the checks of pgexcite.core.ladder. Goes below condensed.c. */

static double ladder_plan[N_V];
static int ladder_reused, ladder_in_charge;

static int all_finite(const double *a, int n) {
    int i;
    for (i = 0; i < n; i++)
        if (a[i] - a[i] != 0) return 0;
    return 1;
}

static void keep(const double *command, double *plan) {
    int i;
    for (i = 0; i < N_V; i++) plan[i] = command[i % N_COMMANDS];
}

static void ladder_reset(void) {
    keep(U_0, ladder_plan);
    ladder_reused = ladder_in_charge = 0;
}

/* Whether a plan may be used: finite, within its bounds, its first move no larger than a move may be. */
static int may_be_used(const double *plan, double cost, const double *last) {
    int i;
    if (!all_finite(plan, N_V) || !all_finite(&cost, 1)) return 0;
    for (i = 0; i < N_V; i++)
        if (plan[i] < LOWER[i] - 1e-9 || plan[i] > UPPER[i] + 1e-9) return 0;
    for (i = 0; i < N_COMMANDS; i++)
        if (fabs(plan[i] - last[i]) > DU_MAX[i] + 1e-6) return 0;
    return 1;
}

/* Level and command, from the plan found, if one was, and its cost in out. */
static void ladder_answer(int active, const double *u_last, int found, const double *plan, ${name}_output *out) {
    static double last[N_COMMANDS], shifted[N_V];
    int i, good;
    for (i = 0; i < N_COMMANDS; i++) last[i] = all_finite(u_last + i, 1) ? u_last[i] : ladder_plan[i];
    good = found && may_be_used(plan, out->cost, last);
    if (good) {
        memcpy(ladder_plan, plan, sizeof ladder_plan);
        ladder_reused = 0;
    } else if (!ladder_in_charge) {
        keep(last, ladder_plan); /* a plan from standby was never in force */
    }
    out->level = good ? 0 : ladder_reused < MAX_REUSE ? 1 : 2;
    if (!active) {
        out->level = 2;
    } else if (out->level == 1) {
        ladder_reused++;
        shift(ladder_plan, shifted);
        memcpy(ladder_plan, shifted, sizeof shifted);
    }
    ladder_in_charge = active && (out->level < 2 || !HAS_CLASSICAL);
    for (i = 0; i < N_COMMANDS; i++) out->command[i] = clipped(out->level < 2 ? ladder_plan[i] : last[i], i);
}
