/* Transitions of samples, chained: what pgexcite.core.prediction makes of a rollout. Goes below rollout.c. */

/* Chains the transitions of N samples into derivatives to the initial states and to n_moves moves; move[j] is in force in sample j.
   Q = N_X + n_moves * N_COMMANDS columns; X holds Q * N_X numbers, twice: of each state those of all columns side by side. */
PGEXCITE_PUBLIC void pgexcite_condense(int N, int n_moves, const int *move, const double *dy, const double *dx, double *X,
                                       double *G) {
    const int Q = N_X + n_moves * N_COMMANDS;
    double *next = X + (long)Q * N_X;
    int j, q, k, i;
    memset(X, 0, sizeof(double) * 2 * Q * N_X);
    for (i = 0; i < N_X; i++) X[i * Q + i] = 1;
    for (j = 0; j < N; j++) {
        const double *Y = dy + (long)j * N_SELECTED * N_COLUMNS, *A = dx + (long)j * N_COLUMNS * N_X;
        /* What comes after the move in force has no effect yet. */
        const int own = N_X + move[j] * N_COMMANDS, until = own + N_COMMANDS;
        double *swap = X, *g = G + (long)j * Q * N_SELECTED;
        memset(g, 0, sizeof(double) * Q * N_SELECTED);
        for (k = 0; k < N_X; k++)
            for (q = 0; q < until; q++)
                for (i = 0; i < N_SELECTED; i++) g[q * N_SELECTED + i] += Y[k * N_SELECTED + i] * X[k * Q + q];
        for (q = own; q < until; q++)
            for (i = 0; i < N_SELECTED; i++) g[q * N_SELECTED + i] += Y[(N_X + q - own) * N_SELECTED + i];
        for (i = 0; i < N_X; i++) {
            double *restrict to = next + (long)i * Q;
            for (q = 0; q < until; q++) to[q] = 0;
            for (k = 0; k < N_X; k++) {
                const double *restrict from = X + (long)k * Q, slope = A[k * N_X + i];
                for (q = 0; q < until; q++) to[q] += slope * from[q];
            }
            for (q = own; q < until; q++) to[q] += A[(N_X + q - own) * N_X + i];
        }
        X = next; next = swap;
    }
}
