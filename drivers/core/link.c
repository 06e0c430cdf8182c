/* What is rare, frames that wait for room, troubles and errors, is the business of the class on top
   (servobench.drivers.wire.link): send_waiting, let_wait, tell_troubles, receiving_failed, transmitting_failed. */
#include "link.h"

#include <assert.h>

#include "attributes.h"
#include "types.h"

enum { ERROR_FLAG = 0x20000000 }; /* of an identifier: an error frame (linux/can.h) */

/* ---- the class on top, and a port in Python ---- */

/* Call a method by its name, which is made once; `arguments[0]` is its object. */
PyObject *call_named(const char *spelt, PyObject **name, PyObject **arguments, size_t count)
{
    if (*name == NULL && (*name = PyUnicode_InternFromString(spelt)) == NULL)
        return NULL;
    return PyObject_VectorcallMethod(*name, arguments, count, NULL);
}

static bool truth_of(PyObject *object, bool *truth)
{
    int said = object == NULL ? -1 : PyObject_IsTrue(object);
    *truth = said > 0;
    return said >= 0;
}

/* The error that is set, if it is one of a bus: its object, and none is set any more. */
static PyObject *take_failure(const LinkObject *self)
{
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    if (!PyErr_GivenExceptionMatches(type, self->failures)) {
        PyErr_Restore(type, value, traceback);
        return NULL;
    }
    PyErr_NormalizeException(&type, &value, &traceback);
    if (traceback != NULL)
        PyException_SetTraceback(value, traceback);
    forget(&type);
    forget(&traceback);
    return value;
}

/* Another error takes the place of one of the bus; always -1. */
static int fail_receiving(LinkObject *self)
{
    static PyObject *name;
    PyObject *error = take_failure(self);
    if (error == NULL)
        return -1;
    PyObject *arguments[] = {(PyObject *)self, error};
    PyObject *raised = call_named("receiving_failed", &name, arguments, 2);
    Py_DecRef(error);
    if (went_well(raised))
        PyErr_Format(PyExc_RuntimeError, "receiving_failed: it must raise");
    return -1;
}

/* Whether the frame is to wait: 0; -1: an error. */
static int fail_transmitting(LinkObject *self, PyObject *at)
{
    static PyObject *name;
    PyObject *error = take_failure(self);
    if (error == NULL)
        return -1;
    PyObject *arguments[] = {(PyObject *)self, error, at};
    bool well = went_well(call_named("transmitting_failed", &name, arguments, 3));
    Py_DecRef(error);
    return well ? 0 : -1;
}

/* As PortWay's; of a port in Python. */
static int receive_in_python(PyObject *port, int64_t until, Arrived *arrived)
{
    static PyObject *name;
    static Attribute came_at = {.spelt = "came_at"}, came_own = {.spelt = "came_own"};
    PyObject *arguments[] = {port, PyLong_FromLongLong(until)};
    PyObject *frame = arguments[1] == NULL ? NULL : call_named("receive", &name, arguments, 2);
    forget(&arguments[1]);
    if (frame == NULL || frame == Py_None) {
        forget(&frame);
        return PyErr_Occurred() ? -1 : 0;
    }
    PyObject *at = attribute(&came_at, port), *own = attribute(&came_own, port);
    bool well = at != NULL && integer(at, &arrived->at) && truth_of(own, &arrived->own)
                && is_a(frame, frame_type, "a WireFrame");
    forget(&at);
    forget(&own);
    arrived->frame = (FrameObject *)frame;
    if (!well)
        Py_DecRef(frame);
    return well ? 1 : -1;
}

static bool tell_troubles(LinkObject *self)
{
    static PyObject *name;
    static Attribute troubles = {.spelt = "troubles"};
    PyObject *told = attribute(&troubles, self->port);
    Py_ssize_t count = told == NULL ? -1 : PyObject_Size(told);
    forget(&told);
    if (count <= 0)
        return count == 0;
    PyObject *arguments[] = {(PyObject *)self};
    return went_well(call_named("tell_troubles", &name, arguments, 1));
}

/* Hand over what the bus takes now; `*until`: when to look again, at the latest. */
static bool send_waiting(LinkObject *self, int64_t *until)
{
    static PyObject *name;
    PyObject *arguments[] = {(PyObject *)self, PyLong_FromLongLong(*until)};
    PyObject *wait = arguments[1] == NULL ? NULL : call_named("send_waiting", &name, arguments, 2);
    bool well = wait != NULL && integer(wait, until);
    forget(&wait);
    forget(&arguments[1]);
    return well;
}

/* True if somebody must receive while time passes: 1, 0, or -1 for an error. A port in C needs none. */
int needs_watching(LinkObject *self)
{
    static Attribute needs = {.spelt = "needs_watching"};
    bool watched;
    if (self->waits || self->way != NULL)
        return self->waits;
    PyObject *said = attribute(&needs, self->port);
    bool well = truth_of(said, &watched);
    forget(&said);
    return well ? watched : -1;
}

/* ---- taps ---- */

static bool show_tap(const TapEntry *entry, const FrameObject *frame, bool sent, int64_t at)
{
    static PyObject *name, *ways[2];
    if (entry->way != NULL)
        return entry->way->take(entry->sink, frame, sent, at);
    if (ways[0] == NULL) {
        ways[0] = PyUnicode_InternFromString("rx");
        ways[1] = PyUnicode_InternFromString("tx");
    }
    PyObject *arguments[] = {entry->tap,
                             ways[sent],
                             PyLong_FromLongLong(frame->can_id),
                             frame->data,
                             PyBool_FromLong(frame->extended),
                             PyBool_FromLong(frame->remote),
                             PyLong_FromLongLong(at)};
    bool well = ways[0] != NULL && ways[1] != NULL && arguments[2] != NULL && arguments[6] != NULL
                && went_well(call_named("frame", &name, arguments, 7));
    forget(&arguments[2]);
    forget(&arguments[4]);
    forget(&arguments[5]);
    forget(&arguments[6]);
    return well;
}

static bool show_taps(LinkObject *self, const FrameObject *frame, bool sent, int64_t at)
{
    for (int place = 0; place < self->tap_count; place++) { /* a tap may add others; none is ever taken away */
        assert(self->tap_count <= LINK_TAPS_MAX);
        if (!show_tap(&self->taps[place], frame, sent, at))
            return false;
    }
    return true;
}

/* ---- in and out ---- */

static int receive(LinkObject *self, int64_t until, Arrived *arrived)
{
    int came = self->way != NULL ? self->way->receive(self->place, until, arrived)
                                 : receive_in_python(self->port, until, arrived);
    if (came < 0)
        return fail_receiving(self);
    if (self->way == NULL && !tell_troubles(self)) {
        if (came > 0)
            Py_DecRef((PyObject *)arrived->frame);
        return -1;
    }
    return came;
}

/* Count a frame and show it; whether it is handed on: 1, 0, or -1 for an error. */
static int take(LinkObject *self, const Arrived *arrived)
{
    const FrameObject *frame = arrived->frame;
    if (frame->can_id >= ERROR_FLAG) {
        self->error_frames++;
        return 0;
    }
    if (arrived->own)
        self->echoed_frames++;
    else
        self->received_frames++;
    if (!arrived->own && !show_taps(self, frame, false, arrived->at))
        return -1;
    if (!frame->extended && !frame->remote)
        return 1;
    self->ignored_frames++;
    return 0;
}

/* Fetch a data frame or an echo by `until` into `last`: 1, 0 if none came, -1 for an error. */
int fetch(LinkObject *self, int64_t until)
{
    for (;;) {
        Arrived arrived;
        int64_t wait = until;
        if (self->waits && !send_waiting(self, &wait))
            return -1;
        int came = receive(self, wait, &arrived);
        if (came == 0 && wait < until)
            continue;
        if (came <= 0)
            return came;
        int taken = take(self, &arrived);
        if (taken > 0) {
            PyObject *before = (PyObject *)self->last;
            self->last = arrived.frame;
            self->last_at = arrived.at;
            self->last_own = arrived.own;
            forget(&before);
            return 1;
        }
        Py_DecRef((PyObject *)arrived.frame);
        if (taken < 0)
            return -1;
    }
}

/* Offer a frame to the bus at `at`: 1; 0 if it has no room for it now, -1 for an error. */
int offer(LinkObject *self, FrameObject *frame, PyObject *at)
{
    static PyObject *name;
    int64_t at_ns;
    PyObject *arguments[] = {self->port, (PyObject *)frame};
    bool well = self->way != NULL ? self->way->transmit(self->place, frame)
                                  : went_well(call_named("transmit", &name, arguments, 2));
    if (!well)
        return fail_transmitting(self, at);
    self->sent_frames++;
    return integer(at, &at_ns) && show_taps(self, frame, true, at_ns) ? 1 : -1;
}

/* Queue a frame; the instant just before the bus was offered it. */
PyObject *hand_over(LinkObject *self, FrameObject *frame)
{
    static PyObject *name;
    PyObject *at = PyObject_Vectorcall(self->now, NULL, 0, NULL);
    int64_t until = 0;
    bool well = at != NULL && integer(at, &frame->handed_at);
    if (well && self->waits) {
        until = frame->handed_at;
        well = send_waiting(self, &until);
    }
    int taken = !well ? -1 : self->waits ? 0 : offer(self, frame, at);
    if (taken == 0) {
        PyObject *arguments[] = {(PyObject *)self, (PyObject *)frame, at};
        taken = went_well(call_named("let_wait", &name, arguments, 3)) ? 1 : -1;
    }
    if (taken < 0)
        forget(&at);
    return at;
}
