#include "answers.h"

#include <assert.h>

/* The instant at `step` of `parts` equal parts of a time, rounded towards minus infinity; exact for any time. */
static int64_t part_of(int64_t time_ns, int64_t step, int64_t parts)
{
    int64_t whole = time_ns / parts, rest = time_ns % parts;
    if (rest < 0) {
        whole--;
        rest += parts;
    }
    return whole * step + rest * step / parts;
}

/* The SYNCs `told` with missing SYNCs between them, at equal distances; how many they are. */
int fill_missing(const Start *told, int count, Start *starts)
{
    int filled = 0;
    for (int number = 0; number < count; number++) {
        const Start *to = &told[number], *from = &told[number > 0 ? number - 1 : 0];
        int64_t apart = to->place - from->place;
        for (int64_t step = 1; apart <= SYNCS_MAX && step < apart; step++) {
            assert(filled < STARTS_MAX);
            starts[filled++] = (Start){from->at + part_of(to->at - from->at, step, apart), from->place + step};
        }
        assert(filled < STARTS_MAX);
        starts[filled++] = *to;
    }
    return filled;
}

/* Pass all answers over if each SYNC since the last look has its one frame, which is nearly always so where none is
   lost: whether it was so. */
bool pass_answers(Stream *self, int64_t *seen, const Start *starts, int count, const Answer *answers, int64_t came)
{
    if (came == 0 || self->step > 1 || count - 1 != came || self->extra_count > 0 || is_repeating(self))
        return false;
    if (starts[0].place != *seen || !self->begun || self->last != *seen)
        return false;
    int64_t delays_ns = 0, before = starts[1].at - 1;
    for (int64_t number = 0; number < came; number++) {
        int64_t start = starts[number + 1].at, at = answers[number].at;
        if (start <= before || at <= start)
            return false;
        delays_ns += at - start;
        before = at;
    }
    int64_t passed = starts[came].place - *seen;
    for (int64_t number = 0; number < came; number++)
        remember_octets(self, &answers[number].octets);
    *seen = starts[came].place;
    pass_frames_over(self, *seen, delays_ns / came, &answers[came - 1].octets, passed);
    return true;
}
