/* Replays a recorded closed loop through the controller and compares its answers with the recorded ones.

   Usage: ${name}_replay replay.txt; exit code 0 where all levels are the same and no command or estimate differs by
   more than the tolerance. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "${name}.h"

static int read_double(FILE *file, double *to, int n) {
    int i;
    for (i = 0; i < n; i++)
        if (fscanf(file, "%lf", to + i) != 1) return 0;
    return 1;
}

static int read_int(FILE *file, int *to, int n) {
    int i;
    for (i = 0; i < n; i++)
        if (fscanf(file, "%d", to + i) != 1) return 0;
    return 1;
}

static int read_input(FILE *file, ${name}_input *in) {
    return $reading;
}

int main(int argc, char **argv) {
    static ${name}_input in;
    static ${name}_output out;
    const double tolerance = $tolerance;
    const double *told = $told;
    double expected[$n_commands], sent[$n_commands], expected_told[1 + $n_told];
    double cost, difference = 0, cost_difference = 0, told_difference = 0;
    int samples = 0, level, iterations, other_levels = 0, other_iterations = 0, i;
    clock_t spent = 0, began;
    FILE *file = argc > 1 ? fopen(argv[1], "r") : NULL;
    if (file == NULL) {
        fprintf(stderr, "usage: %s replay.txt\n", argv[0]);
        return 2;
    }
    ${name}_reset();
    while (read_input(file, &in)) {
        if (!read_int(file, &level, 1) || !read_double(file, expected, $n_commands) || !read_double(file, sent, $n_commands) ||
            !read_double(file, &cost, 1) || !read_int(file, &iterations, 1) ||
            !read_double(file, expected_told, $n_told)) {
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
        if (cost < INFINITY && !(fabs(out.cost - cost) <= cost_difference)) cost_difference = fabs(out.cost - cost);
        for (i = 0; i < $n_told; i++) {
            double d = fabs(told[i] - expected_told[i]) / (1 + fabs(expected_told[i]));
            int both_nothing = told[i] != told[i] && expected_told[i] != expected_told[i];
            if (!both_nothing && !(d <= told_difference)) told_difference = d;
        }
        other_levels += out.level != level;
        other_iterations += out.iterations != iterations;
        began = clock();
        ${name}_prepare(sent);
        spent += clock() - began;
        samples++;
    }
    if (!feof(file)) {
        fprintf(stderr, "sample %d of %s cannot be read\n", samples, argv[1]);
        return 2;
    }
    fclose(file);
    printf("samples %d\n", samples);
    printf("samples on another level %d\n", other_levels);
    printf("largest difference of a command %.3e\n", difference);
    printf("largest difference of a cost %.3e\n", cost_difference);
    if ($n_told > 0) printf("largest difference of an estimate %.3e\n", told_difference);
    printf("samples with another number of iterations %d\n", other_iterations);
    printf("mean time of a sample %.3e s\n", (double)spent / CLOCKS_PER_SEC / (samples > 0 ? samples : 1));
    return samples > 0 && other_levels == 0 && difference <= tolerance && told_difference <= tolerance ? 0 : 1;
}
