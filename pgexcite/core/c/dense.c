/* Dense symmetric positive definite matrices, row by row. */

#include <math.h>

/* Cholesky factor of a matrix of order n, in the lower triangle in place; 0 where it is not positive definite. */
static int cholesky(double *A, int n) {
    int i, j, k;
    for (j = 0; j < n; j++) {
        for (i = j; i < n; i++) {
            double sum = A[i * n + j];
            for (k = 0; k < j; k++) sum -= A[i * n + k] * A[j * n + k];
            if (i == j) {
                if (!(sum > 0)) return 0;
                A[j * n + j] = sqrt(sum);
            } else {
                A[i * n + j] = sum / A[j * n + j];
            }
        }
    }
    return 1;
}

/* Solves L y = x in place. */
static void forward(const double *L, int n, double *x) {
    int i, k;
    for (i = 0; i < n; i++) {
        for (k = 0; k < i; k++) x[i] -= L[i * n + k] * x[k];
        x[i] /= L[i * n + i];
    }
}

/* Solves L' y = x in place. */
static void backward(const double *L, int n, double *x) {
    int i, k;
    for (i = n - 1; i >= 0; i--) {
        for (k = i + 1; k < n; k++) x[i] -= L[k * n + i] * x[k];
        x[i] /= L[i * n + i];
    }
}
