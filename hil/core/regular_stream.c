/* While a stream was regular for long enough, a frame is one too many if the next one comes in its own time as if it
   had not been there:

       place     61   62   63   64 64   65      a SYNC each, or a time
       frames    a    b    c    d  x    e       x: nobody asked for it

   Of two frames of one SYNC that is taken for the extra one whose delay is less usual. One that equals another of the
   last frames is no news: a bus, an adapter or a gateway may repeat it.

   Where the answer to the next SYNC was lost, and not held back, the one after that proves the same of frames that
   came too early to answer it.

   The next one proves nothing if its delay is off the usual one by more than half a period, or is rather that of the
   frame in question. Then answers have changed sides of their SYNCs: they take about a period, or took more and now
   take less, or a SYNC not heard was elsewhere than thought. */
#include "regular_stream.h"

#include <assert.h>
#include <math.h>
#include <string.h>

static bool are_equal(const Octets *one, const Octets *other)
{
    return one->length == other->length && memcmp(one->data, other->data, OCTETS_MAX) == 0;
}

/* Whether the network repeats frames: then one equal to a recent one proves no answer. */
bool is_repeating(const Stream *self) { return self->repetitions >= REPEATS; }

/* Expect the frame at `place` next: nothing was ever lost. */
void trust_stream(Stream *self, int64_t place)
{
    self->begun = true;
    self->last = place - self->step;
    self->regular = self->least;
}

void remember_octets(Stream *self, const Octets *octets)
{
    assert(0 <= self->recent_first && self->recent_first < RECENT && self->recent_count <= RECENT);
    self->recent[(self->recent_first + self->recent_count) % RECENT] = *octets;
    if (self->recent_count < RECENT)
        self->recent_count++;
    else
        self->recent_first = (self->recent_first + 1) % RECENT;
}

/* Whether one of the recent frames had them, suspected or not. */
static bool is_known(const Stream *self, const Octets *octets)
{
    for (int place = 0; place < self->recent_count; place++) /* a ring is full or begins at 0 */
        if (are_equal(&self->recent[place], octets))
            return true;
    for (int place = 0; place < self->extra_count; place++)
        if (are_equal(&self->extras[place].octets, octets))
            return true;
    return false;
}

static double off_usual_ns(const Stream *self, const StreamFrame *frame)
{
    return fabs((double)frame->delay_ns - self->usual_ns);
}

/* Whether a frame is likelier the usual answer of a period before or after. */
static bool is_on_other_side(const Stream *self, const StreamFrame *frame)
{
    return off_usual_ns(self, frame) > self->half_ns;
}

static bool is_one_on_other_side(const Stream *self)
{
    for (int place = 0; place < self->extra_count; place++)
        if (is_on_other_side(self, &self->extras[place]))
            return true;
    return false;
}

/* Whether a frame is as late as a suspected one, and not as usual. */
static bool is_as_extras(const Stream *self, const StreamFrame *frame)
{
    double off_ns = off_usual_ns(self, frame);
    for (int place = 0; off_ns > self->noise_ns && place < self->extra_count; place++) {
        int64_t apart_ns = frame->delay_ns - self->extras[place].delay_ns;
        if (fabs((double)apart_ns) < off_ns)
            return true;
    }
    return false;
}

/* The suspected frames are genuine, and may be repeated like any frame. */
static void clear_of_doubt(Stream *self)
{
    for (int place = 0; place < self->extra_count; place++)
        remember_octets(self, &self->extras[place].octets);
    self->extra_count = 0;
}

static void give_extras(Stream *self, Surplus *found)
{
    assert(found->count == 0);
    for (int place = 0; place < self->extra_count; place++)
        found->frames[found->count++] = self->extras[place];
    self->extra_count = 0;
}

/* The surplus frames before `frame`, a regular one. */
static void judge_extras(Stream *self, const StreamFrame *frame, Surplus *found)
{
    const StreamFrame *before = &self->frame;
    bool back = are_equal(&frame->octets, &before->octets);
    if ((self->same && !back) || (before->repeated && (is_repeating(self) || !back)))
        clear_of_doubt(self);
    if (is_on_other_side(self, frame) || is_as_extras(self, frame))
        clear_of_doubt(self);
    if (before->repeated)
        self->repetitions -= self->extra_count;
    give_extras(self, found);
}

/* A frame that comes before the next one is due. */
static void suspect(Stream *self, bool at_same_place, StreamFrame frame)
{
    if (at_same_place && off_usual_ns(self, &frame) < off_usual_ns(self, &self->frame)) {
        StreamFrame before = self->frame;
        self->frame = frame;
        remember_octets(self, &frame.octets);
        frame = before;
    }
    if (!frame.repeated) {
        assert(self->extra_count < EXTRAS_MAX);
        self->extras[self->extra_count++] = frame;
    }
}

/* Take a frame, `delay_ns` after what it answers; `found`: the surplus ones before it. */
void take_frame(Stream *self, int64_t place, int64_t delay_ns, const Octets *octets, int64_t at, Surplus *found)
{
    StreamFrame frame = {at, delay_ns, *octets, !self->alike && is_known(self, octets)};
    int64_t moved = self->begun ? place - self->last : self->step;
    bool repetition = frame.repeated && is_repeating(self);
    bool lost = moved > self->step && !self->held && !is_one_on_other_side(self);
    int64_t off = moved > self->step ? moved - self->step : self->step - moved;
    found->count = 0;
    if (off <= self->tolerance || (lost && self->extra_count > 0)) {
        remember_octets(self, octets);
        if (self->extra_count > 0)
            judge_extras(self, &frame, found);
        self->begun = true;
        self->last = place;
        self->frame = frame;
        self->regular = repetition || lost ? 0 : self->regular + 1;
        self->repetitions += repetition;
        self->usual_ns += ((double)delay_ns - self->usual_ns) / LEARNT;
        return;
    }
    bool extra = 0 <= moved && moved < self->step;
    if (extra) {
        self->doubled = true;
        repetition = frame.repeated || (self->frame.repeated && !is_repeating(self));
    }
    self->repetitions += repetition;
    if (extra && self->regular >= self->least && self->extra_count < EXTRAS_MAX) {
        suspect(self, moved == 0, frame);
        return;
    }
    clear_of_doubt(self);
    remember_octets(self, octets);
    self->begun = true;
    self->last = place;
    self->frame = frame;
    self->regular = 0;
}

/* Frames have come, one for each of the `count` places after the last, until `place`; `delay_ns`: their mean. The
   caller has remembered them. */
void pass_frames_over(Stream *self, int64_t place, int64_t delay_ns, const Octets *last, int64_t count)
{
    double part = (double)count / LEARNT;
    self->begun = true;
    self->last = place;
    self->regular += count;
    self->usual_ns += ((double)delay_ns - self->usual_ns) * (part < 1.0 ? part : 1.0);
    self->frame = (StreamFrame){0, delay_ns, *last, false};
}

/* No more frames come: those since the last regular one are surplus. */
void end_stream(Stream *self, Surplus *found)
{
    if (self->frame.repeated && is_repeating(self))
        clear_of_doubt(self);
    int left = 0;
    for (int place = 0; place < self->extra_count; place++)
        if (!is_on_other_side(self, &self->extras[place]))
            self->extras[left++] = self->extras[place];
    self->extra_count = left;
    found->count = 0;
    give_extras(self, found);
}
