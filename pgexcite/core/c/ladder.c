/* What reaches the plant: this plan, an old one, or the last command; the checks of pgexcite.core.ladder. Goes below condensed.c.

   N_MEASURED signals are looked at for their age; none where the state is told. */

static double ladder_plan[N_V], ladder_move[N_COMMANDS], ladder_last[N_COMMANDS];
static int ladder_reused, ladder_in_charge;

#if N_MEASURED > 0
static double ladder_seen[N_MEASURED];
static int ladder_stale, ladder_has_seen;
#endif

static void keep(const double *command, double *plan) {
    int i;
    for (i = 0; i < N_V; i++) plan[i] = command[i % N_COMMANDS];
}

static void ladder_reset(void) {
    keep(U_0, ladder_plan);
    memset(ladder_move, 0, sizeof ladder_move);
    ladder_reused = ladder_in_charge = 0;
#if N_MEASURED > 0
    ladder_stale = ladder_has_seen = 0;
#endif
}

#if N_MEASURED > 0
/* What is believed of what is told, and how old it is: lost where a signal is not finite or beyond what any instrument shows, stale
   where all stay the same to the last bit although the command has moved. */
static void ladder_look(const double *told, double *measured) {
    int i, lost = 0, hangs = ladder_has_seen, moved = ladder_stale > 0;
    for (i = 0; i < N_COMMANDS; i++) moved |= fabs(ladder_move[i]) > MOVED_COMMAND;
    for (i = 0; i < N_MEASURED; i++) {
        int believed = fabs(told[i]) <= PLAUSIBLE;
        measured[i] = believed ? told[i] : NAN;
        lost |= !believed;
        hangs &= measured[i] == ladder_seen[i];
        ladder_seen[i] = measured[i];
    }
    ladder_has_seen = 1;
    ladder_stale = lost || (hangs && moved) ? ladder_stale + (ladder_stale <= MAX_AGE) : 0;
}

static int ladder_is_stale(void) { return ladder_stale > MAX_AGE; }
#endif

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
    for (i = 0; i < N_COMMANDS; i++) {
        out->command[i] = clipped(out->level < 2 ? ladder_plan[i] : last[i], i);
        /* With computing delay it is the command before this one that is sent now. */
        if (DELAYED)
            ladder_move[i] = ladder_in_charge ? last[i] - ladder_last[i] : 0;
        else
            ladder_move[i] = out->command[i] - last[i];
        if (out->level == 2) ladder_move[i] = 0;
        ladder_last[i] = last[i];
    }
    ladder_in_charge = active && (out->level < 2 || !HAS_CLASSICAL);
}
