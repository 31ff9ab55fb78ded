/* States and constant disturbances of a linear model from what is measured: the filter of pgexcite.core.offset_free. Goes below
   local.c and kalman.c.

   The mean has the states, the disturbances of N_SHIFTS outputs and those of N_PUSHES torques. */

/* Largest innovation of the last measurement; NaN where all of it was lost. */
static double surprise;

static void filter_reset(void) {
    int i;
    surprise = 0;
    memset(covariance, 0, sizeof covariance);
    memcpy(mean, START, sizeof mean);
    for (i = 0; i < N_MEAN; i++) covariance[i * N_MEAN + i] = 100 * WALK[i];
}

/* What the disturbances of torques move the states by in a sample. */
static void push_of(double *push) {
    int i, k;
    for (i = 0; i < N_X; i++) {
        push[i] = 0;
        for (k = 0; k < N_PUSHES; k++) push[i] += TORQUES[i * N_TORQUES + k] * mean[N_X + N_SHIFTS + k];
    }
}

/* What the disturbances of outputs add to one. */
static double shift_of(int output) {
    double sum = 0;
    int k;
    for (k = 0; k < N_SHIFTS; k++) sum += ON_OUTPUTS[output * N_SHIFTS + k] * mean[N_X + k];
    return sum;
}

/* Finite, and no disturbance larger than any that an undamaged plant could explain. */
static int is_sound(void) {
    int i;
    if (!all_finite(mean, N_MEAN) || !all_finite(covariance, N_MEAN * N_MEAN)) return 0;
    for (i = N_X; i < N_MEAN; i++)
        if (fabs(mean[i]) > LARGEST) return 0;
    return 1;
}

static void filter_predict(const Transition *step) {
    static double x[N_MEAN], A[N_MEAN * N_MEAN], Q[N_MEAN * N_MEAN];
    int i, j, k;
    memset(A, 0, sizeof A); memset(Q, 0, sizeof Q);
    for (i = 0; i < N_MEAN; i++) {
        x[i] = i < N_X ? step->x[i] : mean[i];
        A[i * N_MEAN + i] = 1;
        Q[i * N_MEAN + i] = WALK[i];
    }
    for (i = 0; i < N_X; i++) {
        for (j = 0; j < N_X; j++) A[i * N_MEAN + j] = step->to_x[j * N_X + i];
        for (k = 0; k < N_PUSHES; k++) A[i * N_MEAN + N_X + N_SHIFTS + k] = TORQUES[i * N_TORQUES + k];
        for (j = 0; j < N_X; j++) {
            double sum = 0;
            for (k = 0; k < N_COMMANDS; k++)
                sum += COMMAND_NOISE * COMMAND_NOISE * step->to_x[(N_X + k) * N_X + i] * step->to_x[(N_X + k) * N_X + j];
            for (k = 0; k < N_TORQUES; k++) sum += TORQUE_NOISE * TORQUE_NOISE * TORQUES[i * N_TORQUES + k] * TORQUES[j * N_TORQUES + k];
            Q[i * N_MEAN + j] += sum;
        }
    }
    kalman_predict(x, A, Q);
}

/* Takes in a measurement, NaN where a signal was lost: outputs the model predicts without disturbances, and their derivatives. */
static int filter_correct(const double *measured, const double *y, const double *to_y) {
    static double innovation[N_SEEN], C[N_SEEN * N_MEAN];
    int k, i;
    memset(C, 0, sizeof C);
    surprise = NAN;
    for (k = 0; k < N_SEEN; k++) {
        int row = SEEN_ROW[k];
        innovation[k] = measured[k] - (y[row] + Y_BIAS[row] + shift_of(row));
        if (innovation[k] - innovation[k] == 0 && !(fabs(innovation[k]) <= surprise)) surprise = fabs(innovation[k]);
        for (i = 0; i < N_X; i++) C[k * N_MEAN + i] = to_y[i * N_SELECTED + row];
        for (i = 0; i < N_SHIFTS; i++) C[k * N_MEAN + N_X + i] = ON_OUTPUTS[row * N_SHIFTS + i];
    }
    return kalman_correct(innovation, C, VARIANCE);
}
