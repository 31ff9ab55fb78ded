/* A Kalman filter step by step, lost measurements left out, the update in Joseph's form: pgexcite.core.kalman. Goes below dense.c.

   Expects N_MEAN numbers in the mean and N_SEEN measurements. */

static double mean[N_MEAN], covariance[N_MEAN * N_MEAN];

/* to = A B, of n x k and k x m. */
static void multiply(const double *A, const double *B, int n, int k, int m, double *to) {
    int i, j, l;
    for (i = 0; i < n; i++)
        for (j = 0; j < m; j++) {
            double sum = 0;
            for (l = 0; l < k; l++) sum += A[i * k + l] * B[l * m + j];
            to[i * m + j] = sum;
        }
}

/* to = A B', of n x k and m x k. */
static void multiply_transposed(const double *A, const double *B, int n, int k, int m, double *to) {
    int i, j, l;
    for (i = 0; i < n; i++)
        for (j = 0; j < m; j++) {
            double sum = 0;
            for (l = 0; l < k; l++) sum += A[i * k + l] * B[j * k + l];
            to[i * m + j] = sum;
        }
}

/* One step on: the mean goes to x, its errors go through A, and noise of covariance Q comes in. */
static void kalman_predict(const double *x, const double *A, const double *Q) {
    static double AP[N_MEAN * N_MEAN], next[N_MEAN * N_MEAN];
    int i, j;
    memcpy(mean, x, sizeof mean);
    multiply(A, covariance, N_MEAN, N_MEAN, N_MEAN, AP);
    multiply_transposed(AP, A, N_MEAN, N_MEAN, N_MEAN, next);
    for (i = 0; i < N_MEAN * N_MEAN; i++) next[i] += Q[i];
    for (i = 0; i < N_MEAN; i++)
        for (j = 0; j < N_MEAN; j++) covariance[i * N_MEAN + j] = (next[i * N_MEAN + j] + next[j * N_MEAN + i]) / 2;
}

/* After a measurement: measured minus predicted (NaN where it was lost), derivatives of what is measured to the mean, variances.
   Returns 0 where the covariance has been lost. */
static int kalman_correct(const double *innovation, const double *C, const double *R) {
    static double seen[N_SEEN * N_MEAN], CP[N_SEEN * N_MEAN], variance[N_SEEN * N_SEEN], gain[N_MEAN * N_SEEN], rest[N_MEAN * N_MEAN];
    static double scaled[N_MEAN * N_SEEN], column[N_SEEN], part[N_MEAN * N_MEAN], noise[N_MEAN * N_MEAN];
    int there[N_SEEN], m = 0, i, j, k;
    for (k = 0; k < N_SEEN; k++)
        if (innovation[k] - innovation[k] == 0) there[m++] = k;
    if (m == 0) return 1;
    for (k = 0; k < m; k++) memcpy(seen + k * N_MEAN, C + there[k] * N_MEAN, sizeof(double) * N_MEAN);
    multiply(seen, covariance, m, N_MEAN, N_MEAN, CP);
    multiply_transposed(CP, seen, m, N_MEAN, m, variance);
    for (k = 0; k < m; k++) variance[k * m + k] += R[there[k]];
    if (!cholesky(variance, m)) return 0;
    for (i = 0; i < N_MEAN; i++) {
        for (k = 0; k < m; k++) column[k] = CP[k * N_MEAN + i];
        forward(variance, m, column);
        backward(variance, m, column);
        for (k = 0; k < m; k++) {
            gain[i * m + k] = column[k];
            scaled[i * m + k] = column[k] * R[there[k]];
            mean[i] += column[k] * innovation[there[k]];
        }
    }
    multiply(gain, seen, N_MEAN, m, N_MEAN, rest);
    for (i = 0; i < N_MEAN; i++)
        for (j = 0; j < N_MEAN; j++) rest[i * N_MEAN + j] = (i == j) - rest[i * N_MEAN + j];
    multiply(rest, covariance, N_MEAN, N_MEAN, N_MEAN, part);
    multiply_transposed(scaled, gain, N_MEAN, m, N_MEAN, noise);
    multiply_transposed(part, rest, N_MEAN, N_MEAN, N_MEAN, covariance);
    for (i = 0; i < N_MEAN * N_MEAN; i++) covariance[i] += noise[i];
    return 1;
}
