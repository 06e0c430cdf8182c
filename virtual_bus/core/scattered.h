/* Random numbers of a counter: the same everywhere, in whatever order they are asked for. */
#ifndef CORE_SCATTERED_H
#define CORE_SCATTERED_H

#include <stdint.h>

/* A number of the 64 bits of a counter, each bit with even chances: the finaliser of splitmix64. */
static inline uint64_t scattered(uint64_t counter)
{
    uint64_t x = counter * 0x9E3779B97F4A7C15u;
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9u;
    x = (x ^ (x >> 27)) * 0x94D049BB133111EBu;
    return x ^ (x >> 31);
}

#endif
