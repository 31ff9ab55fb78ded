/* The unscented filter of pgexcite.plugins.estimators.mapped_filter, operation by operation.

   Goes below step.c (whose work arrays it shares) and dense.c. Expects the functions propagate and sense, and sizes and arrays named
   UKF_... */

#define UKF_POINTS (2 * UKF_N + 1)

/* What is expected to be measured, by the sigma points as they are within their bounds. weight is the inverse of S. */
typedef struct {
    double x[UKF_N], P[UKF_N * UKF_N], z[UKF_M], S[UKF_M * UKF_M], C[UKF_N * UKF_M], weight[UKF_M * UKF_M];
} Expectation;

static double ukf_x[UKF_N], ukf_P[UKF_N * UKF_N], ukf_sigmas[UKF_POINTS * UKF_N], ukf_input;

static double ukf_within(double value, double lowest, double highest) {
    return value < lowest ? lowest : value > highest ? highest : value;
}

static double ukf_larger(double a, double b) { return b > a ? b : a; }

static void ukf_symmetric(double *P, int n) {
    int i, k;
    for (i = 0; i < n; i++)
        for (k = 0; k < i; k++) P[i * n + k] = P[k * n + i] = (P[i * n + k] + P[k * n + i]) / 2;
}

/* Sigma points around x, a row each; 0 where P is not positive definite. */
static int ukf_draw(const double *x, const double *P, double *points) {
    static double root[UKF_N * UKF_N];
    int i, k;
    for (i = 0; i < UKF_N * UKF_N; i++) root[i] = UKF_SCALE * P[i];
    if (!cholesky(root, UKF_N)) return 0;
    for (i = 0; i < UKF_N; i++) points[i] = x[i];
    for (k = 0; k < UKF_N; k++)
        for (i = 0; i < UKF_N; i++) {
            double d = i >= k ? root[i * UKF_N + k] : 0;
            points[(1 + k) * UKF_N + i] = x[i] + d;
            points[(1 + UKF_N + k) * UKF_N + i] = x[i] - d;
        }
    return 1;
}

static void ukf_clip(double *points, int count) {
    int j, i;
    for (j = 0; j < count; j++)
        for (i = 0; i < UKF_N; i++) points[j * UKF_N + i] = ukf_within(points[j * UKF_N + i], UKF_LOWER[i], UKF_UPPER[i]);
}

static double ukf_weight(int j, int of_covariance) {
    return j > 0 ? UKF_WEIGHT : of_covariance ? UKF_WEIGHT_0_P : UKF_WEIGHT_0;
}

/* Mean and covariance, not symmetrised, of points of n numbers. */
static void ukf_moments(const double *points, int n, double *mean, double *P) {
    int j, i, k;
    for (i = 0; i < n; i++) mean[i] = 0;
    for (i = 0; i < n * n; i++) P[i] = 0;
    for (j = 0; j < UKF_POINTS; j++)
        for (i = 0; i < n; i++) mean[i] += ukf_weight(j, 0) * points[j * n + i];
    for (j = 0; j < UKF_POINTS; j++)
        for (i = 0; i < n; i++) {
            double weighted = ukf_weight(j, 1) * (points[j * n + i] - mean[i]);
            for (k = 0; k < n; k++) P[i * n + k] += weighted * (points[j * n + k] - mean[k]);
        }
}

/* One sample further; Q is the walk of a second. */
static int ukf_predict(const double *Q) {
    static double points[UKF_POINTS * UKF_N], after[UKF_POINTS * UKF_N], x[UKF_N];
    int j, i;
    if (!ukf_draw(ukf_x, ukf_P, points)) return 0;
    ukf_clip(points, UKF_POINTS);
    for (j = 0; j < UKF_POINTS; j++) {
        args[0] = points + j * UKF_N; args[1] = &ukf_input;
        results[0] = after + j * UKF_N;
        propagate(args, results, iwork, work, 0);
    }
    ukf_moments(after, UKF_N, x, ukf_P);
    for (i = 0; i < UKF_N * UKF_N; i++) ukf_P[i] += Q[i] * UKF_DT;
    for (i = 0; i < UKF_N; i++) {
        double share = UKF_SHARE[i] * (x[i] - ukf_x[i]);
        ukf_P[i * UKF_N + i] += share * share;
    }
    ukf_symmetric(ukf_P, UKF_N);
    memcpy(ukf_x, x, sizeof ukf_x);
    return ukf_draw(ukf_x, ukf_P, ukf_sigmas);
}

/* What would be measured at these sigma points. */
static void ukf_expect(const double *sigmas, Expectation *to) {
    static double points[UKF_POINTS * UKF_N], seen[UKF_POINTS * UKF_M], factor[UKF_M * UKF_M];
    int j, i, k;
    memcpy(points, sigmas, sizeof points);
    ukf_clip(points, UKF_POINTS);
    for (j = 0; j < UKF_POINTS; j++) {
        args[0] = points + j * UKF_N; args[1] = &ukf_input;
        results[0] = seen + j * UKF_M;
        sense(args, results, iwork, work, 0);
    }
    ukf_moments(points, UKF_N, to->x, to->P);
    ukf_symmetric(to->P, UKF_N);
    ukf_moments(seen, UKF_M, to->z, to->S);
    ukf_symmetric(to->S, UKF_M);
    for (i = 0; i < UKF_M; i++) to->S[i * UKF_M + i] += UKF_R[i];
    memset(to->C, 0, sizeof to->C);
    for (j = 0; j < UKF_POINTS; j++)
        for (i = 0; i < UKF_N; i++)
            for (k = 0; k < UKF_M; k++)
                to->C[i * UKF_M + k] +=
                    (points[j * UKF_N + i] - to->x[i]) * (ukf_weight(j, 1) * (seen[j * UKF_M + k] - to->z[k]));
    memcpy(factor, to->S, sizeof factor);
    k = cholesky(factor, UKF_M); /* never 0 but for what is not finite: S is R and more */
    for (i = 0; i < UKF_M; i++) {
        double *column = to->weight + i * UKF_M;
        for (j = 0; j < UKF_M; j++) column[j] = k ? i == j : NAN;
        forward(factor, UKF_M, column);
        backward(factor, UKF_M, column);
    }
}

/* Normalised innovation squared. */
static double ukf_surprise(const Expectation *of, const double *z) {
    double total = 0;
    int i, k;
    for (i = 0; i < UKF_M; i++)
        for (k = 0; k < UKF_M; k++) total += (z[i] - of->z[i]) * of->weight[i * UKF_M + k] * (z[k] - of->z[k]);
    return total;
}

static void ukf_update(const Expectation *by, const double *z) {
    static double K[UKF_N * UKF_M];
    int i, k, m;
    for (i = 0; i < UKF_N; i++)
        for (m = 0; m < UKF_M; m++) {
            double sum = 0;
            for (k = 0; k < UKF_M; k++) sum += by->C[i * UKF_M + k] * by->weight[k * UKF_M + m];
            K[i * UKF_M + m] = sum;
        }
    for (i = 0; i < UKF_N; i++) {
        ukf_x[i] = by->x[i];
        for (m = 0; m < UKF_M; m++) ukf_x[i] += K[i * UKF_M + m] * (z[m] - by->z[m]);
        for (k = 0; k < UKF_N; k++) {
            double sum = 0;
            for (m = 0; m < UKF_M; m++) sum += K[i * UKF_M + m] * by->C[k * UKF_M + m];
            ukf_P[i * UKF_N + k] = by->P[i * UKF_N + k] - sum;
        }
    }
    ukf_clip(ukf_x, 1);
    ukf_symmetric(ukf_P, UKF_N);
}
