/* Two numbers that have the same done to them, in one register; each is rounded as if it were alone. */
#ifndef CORE_PAIRS_H
#define CORE_PAIRS_H

typedef double Pair __attribute__((vector_size(16)));

/* The second before the first. */
static inline Pair swapped(Pair pair) { return (Pair){pair[1], pair[0]}; }

#endif
