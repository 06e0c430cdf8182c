/* Which command an echo is of. */
#include "awaited.h"

#include <assert.h>
#include <string.h>

#include "attributes.h"
#include "frames.h"

void begin_awaiting(Awaited *self)
{
    self->waiting.most = AWAITED_MAX;
    self->overtaken.most = OVERTAKEN_MAX;
}

/* Take the frame at `place` out; its references are the caller's. */
static SentFrame take_out(SentFrames *self, int place)
{
    assert(0 <= place && place < self->count);
    SentFrame taken = self->frames[place];
    self->count--;
    memmove(&self->frames[place], &self->frames[place + 1], (size_t)(self->count - place) * sizeof taken);
    return taken;
}

static void let_go(SentFrame frame)
{
    Py_DecRef(frame.data);
    Py_DecRef(frame.command);
}

/* Put a frame, with its references, behind the others; the oldest goes where there are too many. */
static void put_behind(SentFrames *self, SentFrame frame)
{
    SentFrame oldest = {0};
    if (self->count == self->most)
        oldest = take_out(self, 0);
    assert(self->count < AWAITED_MAX);
    self->frames[self->count++] = frame;
    if (oldest.data != NULL)
        let_go(oldest);
}

static void empty(SentFrames *self)
{
    while (self->count > 0)
        let_go(take_out(self, self->count - 1));
}

void end_awaiting(Awaited *self)
{
    empty(&self->waiting);
    empty(&self->overtaken);
}

static int visit_frames(SentFrames *self, visitproc visit, void *argument)
{
    int result = 0;
    for (int place = 0; result == 0 && place < self->count; place++)
        result = visit_one(self->frames[place].command, visit, argument);
    return result;
}

int visit_awaited(Awaited *self, visitproc visit, void *argument)
{
    int result = visit_frames(&self->waiting, visit, argument);
    return result ? result : visit_frames(&self->overtaken, visit, argument);
}

void await_echo(Awaited *self, PyObject *data, PyObject *command, int64_t handed_at)
{
    put_behind(&self->waiting, (SentFrame){another(data), another(command), handed_at});
}

/* The frame handed over at that instant was never sent. */
bool give_up(Awaited *self, int64_t handed_at)
{
    static Attribute unsent = {.spelt = "unsent"};
    for (int place = 0; place < self->waiting.count; place++) {
        if (self->waiting.frames[place].handed_at != handed_at)
            continue;
        SentFrame frame = take_out(&self->waiting, place);
        PyObject *truth = PyBool_FromLong(true);
        bool well = set_attribute(&unsent, frame.command, truth);
        Py_DecRef(truth);
        let_go(frame);
        return well;
    }
    return true;
}

static bool are_same(PyObject *one, PyObject *other)
{
    char *octets, *others;
    Py_ssize_t length, other_length;
    if (PyBytes_AsStringAndSize(one, &octets, &length) < 0
        || PyBytes_AsStringAndSize(other, &others, &other_length) < 0)
        return false; /* it is checked where it comes in */
    return length == other_length && memcmp(octets, others, (size_t)length) == 0;
}

static bool fits(const SentFrame *frame, PyObject *data, int64_t handed_at)
{
    return (handed_at == UNTOLD || handed_at == frame->handed_at) && are_same(frame->data, data);
}

/* The echo at `at` may be of any of the frames with these octets. */
static bool note_maybe(SentFrames *self, PyObject *data, PyObject *at)
{
    static Attribute maybe_at = {.spelt = "maybe_at"};
    bool well = true;
    for (int place = 0; well && place < self->count; place++) {
        if (!are_same(self->frames[place].data, data))
            continue;
        PyObject *command = another(self->frames[place].command), *noted = attribute(&maybe_at, command);
        well = noted != NULL && (is_there(noted) || set_attribute(&maybe_at, command, at));
        forget(&noted);
        Py_DecRef(command);
    }
    return well;
}

/* The frame that an echo is of, taken out: of those that wait the first, of those overtaken the last. */
static bool find(Awaited *self, PyObject *data, int64_t handed_at, SentFrame *found, bool *waited)
{
    SentFrames *waiting = &self->waiting, *overtaken = &self->overtaken;
    for (int place = 0; place < waiting->count; place++) {
        if (!fits(&waiting->frames[place], data, handed_at))
            continue;
        *found = take_out(waiting, place);
        while (place-- > 0)
            put_behind(overtaken, take_out(waiting, 0));
        *waited = true;
        return true;
    }
    for (int place = overtaken->count - 1; place >= 0; place--) {
        if (!fits(&overtaken->frames[place], data, handed_at))
            continue;
        *found = take_out(overtaken, place);
        *waited = false;
        return true;
    }
    return false;
}

/* Match an echo of this RPDO. Without an instant of hand-over it belongs to the first command with such octets since the
   last one seen; or, if the bus let frames overtake each other, to the last one before. It may also belong to others
   waiting with the same octets. */
bool take_echo(Awaited *self, PyObject *data, int64_t at, int64_t handed_at)
{
    static Attribute on_bus_at = {.spelt = "on_bus_at"};
    SentFrame found;
    bool waited;
    if (!find(self, data, handed_at, &found, &waited))
        return true;
    PyObject *instant = PyLong_FromLongLong(at);
    bool well = instant != NULL && set_attribute(&on_bus_at, found.command, instant);
    if (well && handed_at == UNTOLD)
        well = (!waited || note_maybe(&self->waiting, data, instant)) && note_maybe(&self->overtaken, data, instant);
    forget(&instant);
    let_go(found);
    return well;
}
