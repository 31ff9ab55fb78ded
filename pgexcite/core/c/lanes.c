/* Several directions side by side, as many as the processor's vectors hold numbers; with one lane they are plain numbers. Lane for
   lane the operations are the same. */

#ifndef LANES
#if !defined(__GNUC__) || N_COLUMNS == 1
#define LANES 1
#elif defined(__AVX512F__) && N_COLUMNS > 4
#define LANES 8
#elif defined(__AVX__) && N_COLUMNS > 2
#define LANES 4
#else
#define LANES 2
#endif
#endif

#if defined(__GNUC__)
typedef double lanes __attribute__((vector_size(8 * LANES), may_alias));
#else
typedef double lanes;
#endif

/* Blocks of lanes that hold all columns. */
#define N_BLOCKS ((N_COLUMNS + LANES - 1) / LANES)
