/* The writer's end of a ring of rows in shared memory. */
#ifndef CORE_RING_H
#define CORE_RING_H

#include <stdbool.h>
#include <stdint.h>

enum {
    /* Places of the header's words, in octets; the counters lie on cache lines of their own. */
    ROW_SIZE_AT = 0,
    CAPACITY_AT = 8,
    WRITTEN_AT = 64,
    READ_AT = 128,
    REFUSED_AT = 192,
    HEADER_BYTES = 256,
    ROW_BYTES_MAX = 1 << 20,
    CAPACITY_MAX = 1 << 30,
};

typedef struct Ring {
    unsigned char *memory; /* NULL: closed */
    uint64_t row_bytes, capacity;
    uint64_t written, limit; /* rows, ever; the first beyond what is known to have room */
} Ring;

bool open_ring(Ring *self, int descriptor, uint64_t row_bytes, uint64_t capacity);
void close_ring(Ring *self);
bool has_room(Ring *self);
unsigned char *next_row(const Ring *self);
void publish_row(Ring *self);
uint64_t counter(const Ring *self, int at);
void count_refused(Ring *self);

#endif
