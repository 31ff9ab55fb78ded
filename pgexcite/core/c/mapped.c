static double work[SZ_W];
static casadi_int iwork[SZ_IW];
static const double *args[SZ_ARG];
static double *results[SZ_RES];

/* FUNCTION at n points, one after the other; `common` is the same for all. */
void pgexcite_map(int n, const double *points, const double *common, double *values) {
    int k;
    for (k = 0; k < n; k++) {
        args[0] = points + (long)k * N_IN; args[1] = common;
        results[0] = values + (long)k * N_OUT;
        FUNCTION(args, results, iwork, work, 0);
    }
}
