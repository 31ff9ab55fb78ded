/* The unscented filter of pgexcite.plugins.estimators: ukf, mapped_filter and network, operation by operation.

   Goes below step.c (whose work arrays it shares) and dense.c. Expects the functions propagate and sense, and the sizes, limits and
   arrays named UKF_...; offers what an estimator has to (pgexcite.core.estimation.Written). */

#define UKF_POINTS (2 * UKF_N + 1)
#define UKF_P_M UKF_ROTOR
#define UKF_OMEGA_BUS (UKF_ROTOR + 1)
#define UKF_X_S (UKF_ROTOR + 2)
#define UKF_BUS (UKF_ROTOR + 3)

/* What is expected to be measured, by the sigma points as they are within their bounds. weight is the inverse of S. */
typedef struct {
    double x[UKF_N], P[UKF_N * UKF_N], z[UKF_M], S[UKF_M * UKF_M], C[UKF_N * UKF_M], weight[UKF_M * UKF_M];
} Expectation;

static double ukf_x[UKF_N], ukf_P[UKF_N * UKF_N], ukf_sigmas[UKF_POINTS * UKF_N], ukf_input;

/* The network: whether x_s is held and the variance put aside then, and the network as it was when it was last settled. */
static int ukf_held;
static double ukf_seen[UKF_M], ukf_aside, ukf_turned, ukf_settled[3], ukf_settled_P[9];

/* Clocks, s, and the running mean of NIS. */
static int ukf_started;
static double ukf_since, ukf_moving, ukf_unexplained, ukf_anew, ukf_mean;

static double ukf_within(double value, double lowest, double highest) {
    return value < lowest ? lowest : value > highest ? highest : value;
}

static double ukf_larger(double a, double b) { return b > a ? b : a; }

static void ukf_symmetric(double *P, int n) {
    int i, k;
    for (i = 0; i < n; i++)
        for (k = 0; k < i; k++) P[i * n + k] = P[k * n + i] = (P[i * n + k] + P[k * n + i]) / 2;
}

/* The filter. */

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

/* The network. */

/* Where (b_d, b_q) goes as the rotor angle grows, per rad, and, of length one, as the voltage of the bus does. */
static void ukf_directions(const double *bus, double *around, double *outwards) {
    double length = ukf_larger(hypot(bus[0], bus[1]), 1e-9);
    around[0] = bus[1]; around[1] = -bus[0];
    outwards[0] = bus[0] / length; outwards[1] = bus[1] / length;
}

/* Covariance of (b_d, b_q) from deviations of delta and v_bus, into a block of a matrix with rows of this length. */
static void ukf_wandered(const double *bus, double delta, double v_bus, double *P, int row) {
    double around[2], outwards[2];
    int i, k;
    ukf_directions(bus, around, outwards);
    for (i = 0; i < 2; i++)
        for (k = 0; k < 2; k++)
            P[i * row + k] = delta * around[i] * (delta * around[k]) + v_bus * outwards[i] * (v_bus * outwards[k]);
}

static double ukf_v_bus(void) { return hypot(ukf_x[UKF_BUS], ukf_x[UKF_BUS + 1]); }

/* Covariance of (x_s, b_d, b_q), with what has been put aside. */
static void ukf_covariance(double *P) {
    double v_t = ukf_larger(ukf_seen[0], UKF_LOWEST), slope_d = -ukf_seen[2] / v_t, slope_q = -ukf_seen[1] / v_t;
    double behind_d = v_t + ukf_x[UKF_X_S] * slope_d, behind_q = ukf_x[UKF_X_S] * slope_q, along[3], d, q, square;
    int i, k;
    for (i = 0; i < 3; i++)
        for (k = 0; k < 3; k++) P[i * 3 + k] = ukf_P[(UKF_X_S + i) * UKF_N + UKF_X_S + k];
    if (!ukf_held || hypot(behind_d, behind_q) < UKF_LOWEST) return;
    /* At given terminals the voltage of the bus is on a straight line in x_s. */
    d = slope_d * ukf_x[UKF_BUS] - slope_q * ukf_x[UKF_BUS + 1];
    q = slope_d * ukf_x[UKF_BUS + 1] + slope_q * ukf_x[UKF_BUS];
    square = behind_d * behind_d + behind_q * behind_q;
    along[0] = 1;
    along[1] = (d * behind_d + q * behind_q) / square;
    along[2] = (q * behind_d - d * behind_q) / square;
    for (i = 0; i < 3; i++)
        for (k = 0; k < 3; k++) P[i * 3 + k] += ukf_aside * along[i] * along[k];
}

/* Take x_s for known from here on. */
static void ukf_hold(void) {
    double column[UKF_N], row[UKF_N];
    int i, k;
    for (i = 0; i < UKF_N; i++) {
        column[i] = ukf_P[i * UKF_N + UKF_X_S];
        row[i] = ukf_P[UKF_X_S * UKF_N + i];
    }
    ukf_aside = row[UKF_X_S];
    for (i = 0; i < UKF_N; i++)
        for (k = 0; k < UKF_N; k++) ukf_P[i * UKF_N + k] -= column[i] * row[k] / ukf_aside;
    for (i = 0; i < UKF_N; i++) ukf_P[i * UKF_N + UKF_X_S] = ukf_P[UKF_X_S * UKF_N + i] = 0;
    ukf_P[UKF_X_S * UKF_N + UKF_X_S] = UKF_HELD * UKF_HELD;
    ukf_held = 1;
}

/* Let it go, as uncertain as it was. */
static void ukf_release(void) {
    double P[9];
    int i, k;
    if (!ukf_held) return;
    ukf_covariance(P);
    for (i = 0; i < 3; i++)
        for (k = 0; k < 3; k++) ukf_P[(UKF_X_S + i) * UKF_N + UKF_X_S + k] = P[i * 3 + k];
    ukf_held = 0;
}

/* Give x_s its value from before again, where it is held, and v_bus one within its bounds. */
static void ukf_keep(double x_s_before) {
    double v_bus = ukf_v_bus(), scale;
    if (ukf_held) ukf_x[UKF_X_S] = x_s_before;
    if (v_bus >= UKF_V_BUS_MIN && v_bus <= UKF_V_BUS_MAX) return;
    scale = ukf_within(v_bus, UKF_V_BUS_MIN, UKF_V_BUS_MAX) / ukf_larger(v_bus, 1e-9);
    ukf_x[UKF_BUS] *= scale;
    ukf_x[UKF_BUS + 1] *= scale;
}

/* Keep the network as it is now: a change starts from here. */
static void ukf_settle(void) {
    memcpy(ukf_settled, ukf_x + UKF_X_S, sizeof ukf_settled);
    ukf_covariance(ukf_settled_P);
    ukf_turned = 0;
}

/* State and covariance with the network as last settled, turned as the rotor has since, uncertain by a jump; the rotor is jolted. */
static void ukf_changed(const double *jump, double *x, double *P) {
    double turn[9] = {1, 0, 0, 0, 0, 0, 0, 0, 0}, half[9], bus[4];
    double *network = x + UKF_X_S, *block = P + UKF_X_S * UKF_N + UKF_X_S;
    int i, k, m;
    turn[4] = turn[8] = cos(ukf_turned);
    turn[5] = sin(ukf_turned);
    turn[7] = -turn[5];
    memcpy(x, ukf_x, sizeof ukf_x); memcpy(P, ukf_P, sizeof ukf_P);
    for (i = 0; i < 3; i++) {
        network[i] = 0;
        for (k = 0; k < 3; k++) {
            network[i] += jump[i > 0 ? 4 : 3] * (turn[i * 3 + k] * ukf_settled[k]);
            half[i * 3 + k] = 0;
            for (m = 0; m < 3; m++) half[i * 3 + k] += turn[i * 3 + m] * ukf_settled_P[m * 3 + k];
        }
    }
    for (i = 0; i < UKF_N; i++)
        for (k = UKF_X_S; k < UKF_N; k++) P[i * UKF_N + k] = P[k * UKF_N + i] = 0;
    for (i = 0; i < 3; i++)
        for (k = 0; k < 3; k++)
            for (m = 0; m < 3; m++) block[i * UKF_N + k] += half[i * 3 + m] * turn[k * 3 + m];
    block[0] += jump[1] * network[0] * (jump[1] * network[0]);
    ukf_wandered(network + 1, jump[0], jump[2], bus, 2);
    for (i = 0; i < 2; i++)
        for (k = 0; k < 2; k++) block[(1 + i) * UKF_N + 1 + k] += bus[i * 2 + k];
    for (i = 0; i < UKF_ROTOR; i++) P[i * UKF_N + i] += UKF_JOLT[i];
}

/* One sample. */

/* Speed of the rotor against the bus, pu. */
static double ukf_slip(const double *x) { return x[UKF_OMEGA] - x[UKF_OMEGA_BUS] - 1; }

static int ukf_propagate(void) {
    static double Q[UKF_N * UKF_N];
    double slip = ukf_slip(ukf_x), x_s = ukf_x[UKF_X_S];
    int i;
    memset(Q, 0, sizeof Q);
    for (i = 0; i < UKF_N; i++) Q[i * UKF_N + i] = UKF_WALK[i];
    if (ukf_since < UKF_HOLD_AFTER) Q[UKF_P_M * UKF_N + UKF_P_M] *= UKF_STEADY;
    if (ukf_mean > UKF_LIMIT_CALM) Q[UKF_OMEGA_BUS * UKF_N + UKF_OMEGA_BUS] *= UKF_RESTLESS;
    ukf_wandered(ukf_x + UKF_BUS, UKF_WALK_DELTA, UKF_WALK_V_BUS, Q + UKF_BUS * UKF_N + UKF_BUS, UKF_N);
    if (!ukf_held) Q[UKF_X_S * UKF_N + UKF_X_S] = UKF_WALK_X_S * UKF_WALK_X_S;
    if (!ukf_predict(Q)) return 0;
    ukf_keep(x_s);
    ukf_turned += UKF_OMEGA_0 * UKF_DT * (slip + ukf_slip(ukf_x)) / 2;
    ukf_since += UKF_DT;
    ukf_moving -= UKF_DT;
    return 1;
}

/* What is expected, how surprising z is, and the change of the network that takes: 0 for none, -1 where none
   explains it, else which jump. Returns 0 where a covariance is none. */
static int ukf_judge(const double *z, Expectation *now, double *surprise, int *change) {
    static double x[UKF_N], P[UKF_N * UKF_N], sigmas[UKF_POINTS * UKF_N];
    static Expectation other;
    double left;
    int k;
    ukf_expect(ukf_sigmas, now);
    *surprise = ukf_surprise(now, z);
    *change = 0;
    ukf_mean += UKF_FORGET * ((UKF_LIMIT < *surprise ? UKF_LIMIT : *surprise) - ukf_mean);
    if (*surprise <= UKF_LIMIT && ukf_mean <= UKF_LIMIT_MEAN) {
        ukf_anew = ukf_larger(ukf_anew - UKF_DT, 0);
        ukf_unexplained = ukf_larger(ukf_unexplained - UKF_FORGIVE * UKF_DT, 0);
        return 1;
    }
    ukf_unexplained += UKF_DT;
    ukf_anew = ukf_anew > 0 ? UKF_WARM_UP : 0;
    for (k = 0; k < UKF_N_JUMPS; k++) {
        ukf_changed(UKF_JUMPS + 5 * k, x, P);
        if (!ukf_draw(x, P, sigmas)) return 0;
        ukf_expect(sigmas, &other);
        left = ukf_surprise(&other, z);
        if (left <= UKF_LIMIT) {
            memcpy(ukf_x, x, sizeof ukf_x); memcpy(ukf_P, P, sizeof ukf_P);
            ukf_held = 0;
            ukf_since = 0; ukf_moving = UKF_HOLD_AFTER; ukf_mean = UKF_M;
            *now = other;
            *surprise = left;
            *change = k + 1;
            return 1;
        }
    }
    *change = -1;
    return 1;
}

static void ukf_correct(const Expectation *now, const double *z) {
    double x_s = ukf_x[UKF_X_S];
    ukf_update(now, z);
    ukf_keep(x_s);
    if (fabs(ukf_slip(ukf_x)) > UKF_SWING) {
        ukf_moving = ukf_larger(ukf_moving, UKF_SETTLED_AFTER);
        ukf_release();
    } else if (ukf_moving <= 0 && !ukf_held) {
        ukf_hold();
    }
    if (ukf_since >= UKF_SETTLED_AFTER && ukf_mean <= UKF_LIMIT_CALM) ukf_settle();
}

static int ukf_is_sane(void) {
    double sum = 0;
    int i;
    for (i = 0; i < UKF_N; i++) {
        if (!(ukf_P[i * UKF_N + i] > 0)) return 0;
        sum += ukf_x[i];
    }
    for (i = 0; i < UKF_N * UKF_N; i++) sum += ukf_P[i];
    return sum - sum == 0;
}

/* Start anew from the initial point, of which next to nothing is taken for certain. */
static void ukf_restart(void) {
    memcpy(ukf_x, UKF_START, sizeof ukf_x); memcpy(ukf_P, UKF_RESTART_P, sizeof ukf_P);
    ukf_held = 0;
    ukf_settle();
    ukf_since = INFINITY; ukf_moving = UKF_HOLD_AFTER; ukf_mean = UKF_M;
    ukf_unexplained = 0; ukf_anew = UKF_WARM_UP;
}

static double estimator_value[UKF_N], estimator_told[UKF_TOLD];

static void ukf_tell(int change, double surprise) {
    double P[9], around[2], outwards[2], of_v = 0, of_delta = 0, v_bus = ukf_v_bus();
    int i, k;
    ukf_covariance(P);
    ukf_directions(ukf_x + UKF_BUS, around, outwards);
    for (i = 0; i < 2; i++)
        for (k = 0; k < 2; k++) {
            of_v += outwards[i] * P[(1 + i) * 3 + 1 + k] * outwards[k];
            of_delta += around[i] * P[(1 + i) * 3 + 1 + k] * around[k];
        }
    memcpy(estimator_value, ukf_x, sizeof ukf_x);
    /* In the order of _TOLD in ukf.py. */
    estimator_told[0] = ukf_x[UKF_X_S];
    estimator_told[1] = sqrt(ukf_larger(P[0], 0));
    estimator_told[2] = v_bus;
    estimator_told[3] = sqrt(ukf_larger(of_v, 0));
    estimator_told[4] = atan2(ukf_x[UKF_BUS], ukf_x[UKF_BUS + 1]);
    estimator_told[5] = sqrt(ukf_larger(of_delta, 0)) / (v_bus * v_bus);
    estimator_told[6] = surprise;
    estimator_told[7] = change;
    estimator_told[8] = ukf_held;
}

/* Forget everything. */
static void estimator_reset(void) {
    memcpy(ukf_x, UKF_START, sizeof ukf_x); memcpy(ukf_P, UKF_START_P, sizeof ukf_P);
    memcpy(ukf_seen, UKF_START_SEEN, sizeof ukf_seen);
    memcpy(ukf_settled, UKF_START + UKF_X_S, sizeof ukf_settled); memcpy(ukf_settled_P, UKF_START_SETTLED_P, sizeof ukf_settled_P);
    ukf_held = 1;
    ukf_aside = UKF_START_ASIDE;
    ukf_turned = 0;
    ukf_started = 0;
    ukf_since = INFINITY; ukf_moving = 0; ukf_mean = UKF_M;
    ukf_unexplained = ukf_anew = 0;
}

/* One sample further: terminals measured now, null where lost, and the field voltage since the last sample. Whether it is sound. */
static int estimator_observe(const double *terminals, double e_fd) {
    static Expectation now;
    double surprise = NAN;
    int change = 0, sane;
    ukf_input = e_fd;
    sane = ukf_started ? ukf_propagate() : ukf_draw(ukf_x, ukf_P, ukf_sigmas);
    if (sane) {
        ukf_started = 1;
        if (terminals != NULL) {
            sane = ukf_judge(terminals, &now, &surprise, &change);
            if (sane) memcpy(ukf_seen, now.z, sizeof ukf_seen);
            if (sane && change >= 0) ukf_correct(&now, terminals);
        }
        sane = sane && ukf_is_sane();
    }
    if (!sane || ukf_unexplained > UKF_PATIENCE) ukf_restart();
    ukf_tell(change, surprise);
    return ukf_anew <= 0;
}
