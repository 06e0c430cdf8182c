/* One writer, one reader in another process, no lock between them; hil/recording/ring.py has the layout.

   A row is stored before its count, so the reader never sees half a row, also when the writer is killed in
   between (C17, 7.17.3: release and acquire). */
#define _GNU_SOURCE /* MAP_POPULATE */
#include "ring.h"

#include <assert.h>
#include <stddef.h>
#include <sys/mman.h>
#include <unistd.h>

static uint64_t *word(const Ring *self, int at)
{
    assert(self->memory != NULL && at >= 0 && at < HEADER_BYTES && at % 8 == 0);
    return (uint64_t *)(void *)(self->memory + at);
}

static size_t bytes_of(const Ring *self) { return HEADER_BYTES + self->capacity * self->row_bytes; }

/* Give the file its size, map it and say in it what it is; false, with errno set, where there is no memory. */
bool open_ring(Ring *self, int descriptor, uint64_t row_bytes, uint64_t capacity)
{
    *self = (Ring){NULL, row_bytes, capacity, 0, capacity};
    if (ftruncate(descriptor, (off_t)bytes_of(self)) < 0)
        return false;
    /* MAP_POPULATE: no page fault on the control thread later */
    void *memory = mmap(NULL, bytes_of(self), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_POPULATE, descriptor, 0);
    if (memory == MAP_FAILED)
        return false;
    self->memory = memory;
    *word(self, ROW_SIZE_AT) = row_bytes;
    *word(self, CAPACITY_AT) = capacity;
    return true;
}

void close_ring(Ring *self)
{
    if (self->memory != NULL)
        munmap(self->memory, bytes_of(self));
    self->memory = NULL;
}

/* A counter of the header, that of the reader too. */
uint64_t counter(const Ring *self, int at) { return __atomic_load_n(word(self, at), __ATOMIC_ACQUIRE); }

/* Whether one more row has room; the reader is asked only where it had none when last asked. */
bool has_room(Ring *self)
{
    if (self->written >= self->limit)
        self->limit = counter(self, READ_AT) + self->capacity;
    return self->written < self->limit;
}

/* Where the next row goes; the writer's own until it is published. */
unsigned char *next_row(const Ring *self)
{
    assert(self->memory != NULL && self->written < self->limit);
    return self->memory + HEADER_BYTES + (self->written & (self->capacity - 1)) * self->row_bytes;
}

void publish_row(Ring *self)
{
    self->written++;
    __atomic_store_n(word(self, WRITTEN_AT), self->written, __ATOMIC_RELEASE);
}

void count_refused(Ring *self)
{
    __atomic_store_n(word(self, REFUSED_AT), *word(self, REFUSED_AT) + 1, __ATOMIC_RELEASE);
}
