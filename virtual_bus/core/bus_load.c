/* Busy is every bit from a start of frame to the end of the intermission after it, so that a bus on which frames
   follow each other without pause has a load of 100 %.

   When the checkpoints are full every second one is dropped and the stride doubles: an interval's busy time is
   exact for the first CHECKPOINTS_MAX frames and later good to the frames between two checkpoints, at worst one in
   2048 of the whole run. */
#include "bus_load.h"

#include <assert.h>

void start_load(BusLoad *self)
{
    self->busy_ns = 0;
    self->count = 0;
    self->stride = self->countdown = 1;
}

static void mark(BusLoad *self, int64_t end)
{
    assert(0 <= self->count && self->count < CHECKPOINTS_MAX);
    self->ends[self->count] = end;
    self->busy[self->count++] = self->busy_ns;
    if (self->count == CHECKPOINTS_MAX) {
        self->count /= 2;
        for (int kept = 0; kept < self->count; kept++) {
            self->ends[kept] = self->ends[2 * kept + 1];
            self->busy[kept] = self->busy[2 * kept + 1];
        }
        self->stride *= 2;
    }
    self->countdown = self->stride;
}

/* The bus was busy for a time up to `end`; ends never decrease. */
void add_load(BusLoad *self, int64_t duration_ns, int64_t end)
{
    self->busy_ns += duration_ns;
    if (--self->countdown == 0)
        mark(self, end);
}

/* Cumulated busy time at an instant; a busy spell lies at the end of its interval. */
int64_t busy_until(const BusLoad *self, int64_t when)
{
    int low = 0, high = self->count;
    while (low < high) {
        int middle = (low + high) / 2;
        if (self->ends[middle] < when)
            low = middle + 1;
        else
            high = middle;
    }
    if (low == self->count)
        return self->busy_ns;
    int64_t before = low ? self->busy[low - 1] : 0;
    int64_t then = self->busy[low] - (self->ends[low] - when);
    return then > before ? then : before;
}

/* Load between two instants, percent; 0 for an empty interval. */
double load_percent(const BusLoad *self, int64_t since, int64_t until)
{
    if (until <= since)
        return 0.0;
    int64_t busy = busy_until(self, until) - busy_until(self, since);
    return 100.0 * (double)busy / (double)(until - since);
}
