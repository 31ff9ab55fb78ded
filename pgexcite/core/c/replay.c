/* Replays a recorded closed loop through the controller and compares its commands with the recorded ones.

   Usage: ${name}_replay replay.txt; exit code 0 where no command differs by more than the tolerance. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "${name}.h"

static int read_numbers(FILE *file, double *to, int n) {
    int i;
    for (i = 0; i < n; i++)
        if (fscanf(file, "%lf", to + i) != 1) return 0;
    return 1;
}

int main(int argc, char **argv) {
    static ${name}_input in;
    static ${name}_output out;
    const double tolerance = $tolerance;
    double expected[$n_commands], cost, difference = 0, cost_difference = 0;
    int samples = 0, i, iterations, other_iterations = 0;
    clock_t spent = 0, began;
    FILE *file = argc > 1 ? fopen(argv[1], "r") : NULL;
    if (file == NULL) {
        fprintf(stderr, "usage: %s replay.txt\n", argv[0]);
        return 2;
    }
    ${name}_reset();
    while (fscanf(file, "%lf %d", &in.t, &in.startup) == 2) {
        if (!read_numbers(file, in.x, $n_x) || !read_numbers(file, in.z, $n_z) || !read_numbers(file, in.d, $n_d) ||
            !read_numbers(file, in.u, $n_u) || !read_numbers(file, in.p, $n_p) || !read_numbers(file, in.u_last, $n_commands) ||
            !read_numbers(file, expected, $n_commands) || !read_numbers(file, &cost, 1) || fscanf(file, "%d", &iterations) != 1) {
            fprintf(stderr, "sample %d of %s is incomplete\n", samples, argv[1]);
            return 2;
        }
        began = clock();
        ${name}_step(&in, &out);
        spent += clock() - began;
        for (i = 0; i < $n_commands; i++) {
            double d = fabs(out.command[i] - expected[i]);
            if (!(d <= difference)) difference = d;
        }
        if (out.level != 0) difference = INFINITY;
        if (!(fabs(out.cost - cost) <= cost_difference)) cost_difference = fabs(out.cost - cost);
        other_iterations += out.iterations != iterations;
        began = clock();
        ${name}_prepare(out.command);
        spent += clock() - began;
        samples++;
    }
    fclose(file);
    printf("samples %d\n", samples);
    printf("largest difference of a command %.3e\n", difference);
    printf("largest difference of a cost %.3e\n", cost_difference);
    printf("samples with another number of iterations %d\n", other_iterations);
    printf("mean time of a sample %.3e s\n", (double)spent / CLOCKS_PER_SEC / (samples > 0 ? samples : 1));
    return samples > 0 && difference <= tolerance ? 0 : 1;
}
