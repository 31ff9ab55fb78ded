/* The horizon of each sample: its intervals cut into steps, with what is known to happen on the way; pgexcite.core.horizons.

   Expects N_KNOWN changes at the instants KNOWN_T, in order, the k-th made of the assignments from KNOWN_FROM[k] up to
   KNOWN_FROM[k + 1]: element SET_AT of u, or of p where SET_P, becomes SET_ADD times what it was plus SET_VALUE. */

#define MAX_PIECES (HORIZON + N_KNOWN)
#define MAX_ROWS (1 + N_KNOWN)
#define SAME_INSTANT 1e-9

typedef struct {
    int pieces, rows, count[MAX_PIECES], move[MAX_PIECES], row[MAX_PIECES], end[MAX_PIECES];
    double length[MAX_PIECES], u[MAX_ROWS * AT_LEAST_1(N_U)], p[MAX_ROWS * AT_LEAST_1(N_P)];
} Horizon;

/* Set-points in force while this controller is in charge. */
static void fix(double *u) {
    int k;
    for (k = 0; k < N_FIXED; k++) u[FIXED_AT[k]] = FIXED_TO[k];
}

static void apply(int change, double *u, double *p) {
    int k;
    for (k = KNOWN_FROM[change]; k < KNOWN_FROM[change + 1]; k++) {
        double *to = (SET_P[k] ? p : u) + SET_AT[k];
        *to = SET_ADD[k] * *to + SET_VALUE[k];
    }
    fix(u);
}

/* Commands and parameters a change later, as a new row. */
static void add_row(int change, Horizon *to) {
    double *u = to->u + to->rows * N_U, *p = to->p + to->rows * N_P;
    memcpy(u, u - N_U, sizeof(double) * N_U); memcpy(p, p - N_P, sizeof(double) * N_P);
    apply(change, u, p);
    to->rows++;
}

static void add_steps(int count, double length, int move, int end, Horizon *to) {
    to->count[to->pieces] = count;
    to->length[to->pieces] = length;
    to->move[to->pieces] = move;
    to->row[to->pieces] = to->rows - 1;
    to->end[to->pieces++] = end;
}

/* A piece of this duration in equal steps of about h; none for a duration of zero that ends no sample. */
static void add_piece(double duration, double h, int move, int end, Horizon *to) {
    double steps = ceil(duration / h - 1e-6);
    int count = steps > 1 ? (int)steps : 1;
    if (duration > SAME_INSTANT || end) add_steps(count, duration / count, move, end, to);
}

/* From t on, with these commands and parameters in force; each interval in this many steps. */
static void horizon_at(double t, const double *u, const double *p, int steps, Horizon *to) {
    double here = t, last = t + ENDS[HORIZON - 1];
    int j, next = 0, until = N_KNOWN;
    to->pieces = 0;
    to->rows = 1;
    memcpy(to->u, u, sizeof(double) * N_U); memcpy(to->p, p, sizeof(double) * N_P);
    fix(to->u);
    while (next < N_KNOWN && KNOWN_T[next] <= t + SAME_INSTANT) next++;
    while (until > next && KNOWN_T[until - 1] >= last - SAME_INSTANT) until--;
    for (j = 0; j < HORIZON; j++) {
        const int rows = to->rows;
        double end = t + ENDS[j], h = INTERVALS[j] / steps;
        for (; next < until && KNOWN_T[next] < end - SAME_INSTANT; next++) {
            add_piece(KNOWN_T[next] - here, h, SAMPLE_MOVE[j], 0, to);
            add_row(next, to);
            if (KNOWN_T[next] > here) here = KNOWN_T[next];
        }
        /* What is not cut has the same steps at any t, to the last bit: what was prepared for steps of this length serves on. */
        if (to->rows == rows)
            add_steps(steps, h, SAMPLE_MOVE[j], 1, to);
        else
            add_piece(end - here, h, SAMPLE_MOVE[j], 1, to);
        here = end;
        for (; next < until && KNOWN_T[next] <= end + SAME_INSTANT; next++) add_row(next, to);
    }
}

/* Commands and parameters in force at `until` where these were at t, as far as changes are known. */
static void between(double t, double until, double *u, double *p) {
    int k;
    for (k = 0; k < N_KNOWN; k++)
        if (t + SAME_INSTANT < KNOWN_T[k] && KNOWN_T[k] <= until + SAME_INSTANT) apply(k, u, p);
}
