/* Transitions of samples, chained: what pgexcite.core.prediction makes of a rollout. Goes below rollout.c. */

/* Chains the transitions of N samples into derivatives to the initial states and to n_moves moves; move[j] is in force in sample j.
   Q = N_X + n_moves * N_COMMANDS columns; X holds Q * N_X numbers, twice. */
PGEXCITE_PUBLIC void pgexcite_condense(int N, int n_moves, const int *move, const double *dy, const double *dx, double *X,
                                       double *G) {
    int Q = N_X + n_moves * N_COMMANDS, j, q, k, i;
    double *next = X + (long)Q * N_X;
    memset(X, 0, sizeof(double) * 2 * Q * N_X);
    for (i = 0; i < N_X; i++) X[i * N_X + i] = 1;
    for (j = 0; j < N; j++) {
        const double *Y = dy + (long)j * N_SELECTED * N_COLUMNS, *A = dx + (long)j * N_COLUMNS * N_X;
        double *swap = X;
        for (q = 0; q < Q; q++) {
            int own = q - N_X - move[j] * N_COMMANDS;
            double *g = G + ((long)j * Q + q) * N_SELECTED, *to = next + (long)q * N_X;
            for (i = 0; i < N_SELECTED; i++) g[i] = own >= 0 && own < N_COMMANDS ? Y[(N_X + own) * N_SELECTED + i] : 0;
            for (i = 0; i < N_X; i++) to[i] = own >= 0 && own < N_COMMANDS ? A[(N_X + own) * N_X + i] : 0;
            if (q >= N_X && q >= N_X + (move[j] + 1) * N_COMMANDS) continue;
            for (k = 0; k < N_X; k++) {
                double v = X[(long)q * N_X + k];
                if (v == 0) continue;
                for (i = 0; i < N_SELECTED; i++) g[i] += Y[k * N_SELECTED + i] * v;
                for (i = 0; i < N_X; i++) to[i] += A[k * N_X + i] * v;
            }
        }
        X = next; next = swap;
    }
}
