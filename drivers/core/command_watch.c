/* Looks for the value that a drive reports among the last commands; native.pyi says what counts as deaf. */
#include "command_watch.h"

#include <assert.h>
#include <stdlib.h>

#include "whole_numbers.h"

enum { WORD_BITS = 32 };

static int64_t way(int64_t start, int64_t end) { return way_between(start, end, WORD_BITS); }

/* The command sent `back` commands before the newest, which is 0. */
static int64_t recent(const CommandWatch *self, int64_t back)
{
    assert(0 <= back && back < self->held);
    int64_t place = self->newest - back;
    return self->recent[place < 0 ? place + self->half : place];
}

void command_sent(CommandWatch *self, int64_t raw)
{
    self->newest = self->newest + 1 == self->half ? 0 : self->newest + 1;
    assert(0 <= self->newest && self->newest < self->half);
    self->recent[self->newest] = raw;
    self->held += self->held < self->half;
    self->sent++;
    if (!self->equal) {
        int64_t from_base = way(self->base, raw);
        if (from_base < self->low)
            self->low = from_base;
        if (from_base > self->high)
            self->high = from_base;
    }
}

/* The drive reports by other means that it does not follow, or why it cannot. */
void command_excused(CommandWatch *self)
{
    self->followed = self->sent;
    self->changed = -1;
}

/* Whether it is one of the last commands; not beyond it if the drive clips. */
static bool is_among(const CommandWatch *self, int64_t raw, bool limited)
{
    for (int64_t back = 0; back < self->held; back++) {
        int64_t command = recent(self, back);
        int64_t margin = self->margin;
        if (self->share != 0)
            margin += floored(command < 0 ? -command : command, self->share);
        if (-margin <= raw - command && raw - command <= margin)
            return true;
        int64_t down = command < 0 ? command : 0, up = command > 0 ? command : 0;
        if (limited && down - margin <= raw && raw <= up + margin)
            return true;
    }
    return false;
}

/* Whether the newest half of the last commands sway about it: it is one of them or, for a speed, a value that a
   drive may show between two commands, included if they differ by less than counts. */
static bool is_near(const CommandWatch *self, int64_t raw)
{
    int64_t count = self->half / 2 > 1 ? self->half / 2 : 1;
    int64_t low = INT64_MAX, high = INT64_MIN;
    bool close = false;
    for (int64_t back = 0; back < count && back < self->held; back++) {
        int64_t to_command = way(raw, recent(self, back));
        low = to_command < low ? to_command : low;
        high = to_command > high ? to_command : high;
        close = close || (-self->margin <= to_command && to_command <= self->margin);
    }
    assert(low <= high);
    if (self->has_least && high - low <= self->least)
        return low - self->margin <= 0 && 0 <= high + self->margin;
    return close;
}

/* Whether the demand has stayed the same for longer than chance, or a ramp, explains. */
static bool stays(const CommandWatch *self, int64_t raw)
{
    if (self->sent - self->changed < self->stays_for)
        return false;
    return self->equal ? self->same >= TOLD_THE_SAME : !is_near(self, raw);
}

static int by_size(const void *one, const void *two)
{
    int64_t first = *(const int64_t *)one, second = *(const int64_t *)two;
    return (first > second) - (first < second);
}

/* Whether the commands spread over more than one demand can represent: the middle half of the last ones, or all
   since the demand has stayed. */
static bool vary(CommandWatch *self)
{
    if (!self->equal)
        return self->high - self->low > 2 * self->margin;
    int64_t newest = recent(self, 0), count = self->held;
    for (int64_t back = 0; back < count; back++)
        self->ways[back] = way(newest, recent(self, back));
    qsort(self->ways, (size_t)count, sizeof *self->ways, by_size);
    return self->ways[3 * count / 4] - self->ways[count / 4] > 2 * self->margin;
}

/* Whether no recent command leads to this speed: 0, or against all of them. A speed that is only slower or faster
   may have been clipped, or raised to the drive's least. */
static bool is_turned_away(const CommandWatch *self, int64_t raw)
{
    if (!self->has_least)
        return false;
    bool all_up = true, all_down = true;
    for (int64_t back = 0; back < self->held; back++) {
        int64_t command = recent(self, back);
        all_up = all_up && command >= self->least;
        all_down = all_down && command <= -self->least;
    }
    return (raw <= 0 && all_up) || (raw >= 0 && all_down);
}

void command_told(CommandWatch *self, int64_t raw, bool limited)
{
    if (limited && (self->share != 0 || !self->equal)) {
        command_excused(self);
        return;
    }
    bool followed = !self->equal || is_among(self, raw, limited);
    if (raw != self->told_raw || self->changed < 0) {
        self->told_raw = raw;
        self->changed = self->sent;
        self->same = self->low = self->high = 0;
        self->base = self->held > 0 ? recent(self, 0) : 0;
    } else {
        self->same += self->sent != self->heard;
        if (followed && !limited && self->share == 0 && stays(self, raw))
            followed = !(vary(self) || is_turned_away(self, raw));
    }
    self->heard = self->sent;
    if (followed)
        self->followed = self->sent;
    else if (self->sent - self->followed >= self->half)
        self->follows = false;
}
