/* One sample of the unscented filter: pgexcite.plugins.estimators.ukf, operation by operation.

   Goes below mapped_filter.c and network.c; offers what an estimator has to (pgexcite.core.estimation.Written). */

/* Clocks, s, and the running mean of NIS. */
static int ukf_started;
static double ukf_since, ukf_moving, ukf_unexplained, ukf_anew, ukf_mean;

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
    ukf_unexplained += UKF_BY_CHANGE * UKF_DT;
    ukf_anew = ukf_anew > 0 ? UKF_WARM_UP : 0;
    for (k = 0; k < UKF_N_JUMPS; k++) {
        ukf_changed(UKF_JUMPS + UKF_JUMP_SIZE * k, z[UKF_P_E] - now->z[UKF_P_E], x, P);
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
    ukf_unexplained += (1 - UKF_BY_CHANGE) * UKF_DT;
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

static double estimator_value[UKF_N], estimator_told[UKF_N_TOLD];

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
    estimator_told[UKF_TOLD_X_S] = ukf_x[UKF_X_S];
    estimator_told[UKF_TOLD_SIGMA_X_S] = sqrt(ukf_larger(P[0], 0));
    estimator_told[UKF_TOLD_V_BUS] = v_bus;
    estimator_told[UKF_TOLD_SIGMA_V_BUS] = sqrt(ukf_larger(of_v, 0));
    estimator_told[UKF_TOLD_DELTA] = atan2(ukf_x[UKF_BUS], ukf_x[UKF_BUS + 1]);
    estimator_told[UKF_TOLD_SIGMA_DELTA] = sqrt(ukf_larger(of_delta, 0)) / (v_bus * v_bus);
    estimator_told[UKF_TOLD_NIS] = surprise;
    estimator_told[UKF_TOLD_NETWORK_CHANGE] = change;
    estimator_told[UKF_TOLD_NETWORK_HELD] = ukf_held;
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
