/* What is believed of the network beyond mean and covariance: pgexcite.plugins.estimators.network, operation by operation.

   Goes below mapped_filter.c. */

/* Whether x_s is held, the variance put aside then, and the network as it was when it was last settled. */
static int ukf_held;
static double ukf_seen[UKF_M], ukf_aside, ukf_turned, ukf_settled[3], ukf_settled_P[9];

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

/* State and covariance with the network as last settled, turned as the rotor has since, uncertain by a jump; the rotor is
   jolted, the more the more power the change made. */
static void ukf_changed(const double *jump, double power, double *x, double *P) {
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
            network[i] += jump[i > 0 ? UKF_JUMP_LEFT_V_BUS : UKF_JUMP_LEFT_X_S] * (turn[i * 3 + k] * ukf_settled[k]);
            half[i * 3 + k] = 0;
            for (m = 0; m < 3; m++) half[i * 3 + k] += turn[i * 3 + m] * ukf_settled_P[m * 3 + k];
        }
    }
    for (i = 0; i < UKF_N; i++)
        for (k = UKF_X_S; k < UKF_N; k++) P[i * UKF_N + k] = P[k * UKF_N + i] = 0;
    for (i = 0; i < 3; i++)
        for (k = 0; k < 3; k++)
            for (m = 0; m < 3; m++) block[i * UKF_N + k] += half[i * 3 + m] * turn[k * 3 + m];
    block[0] += jump[UKF_JUMP_X_S] * network[0] * (jump[UKF_JUMP_X_S] * network[0]);
    ukf_wandered(network + 1, jump[UKF_JUMP_DELTA], jump[UKF_JUMP_V_BUS], bus, 2);
    for (i = 0; i < 2; i++)
        for (k = 0; k < 2; k++) block[(1 + i) * UKF_N + 1 + k] += bus[i * 2 + k];
    for (i = 0; i < UKF_ROTOR; i++) P[i * UKF_N + i] += UKF_JOLT[i] + UKF_LATE[i] * (power * power);
}
