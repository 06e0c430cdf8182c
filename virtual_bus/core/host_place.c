/* What comes in and what goes out can be given to a judge, who passes, loses or holds each frame. What is held waits
   on the segment's own timeline, so a fault costs one event and no polling:

       segment -- end of frame --> judge -- at once, or at its release --> inbox -- receive --> owner
       owner -- transmit --> judge -- at once, or at its release --> transmit queue --> segment
       segment -- end of an own frame --> inbox */
#include "host_place.h"

#include <assert.h>

#include "objects.h"
#include "types.h"

/* False for an error; `kept` is false if there was no room. */
bool hold_frame(HeldObject *self, PyObject *frame, int64_t release, int mark, bool *kept)
{
    *kept = self->heap.count < HELD_MAX;
    if (*kept)
        return enter(&self->heap, release, frame, mark);
    self->overflow++;
    return true;
}

/* ---- inbox ---- */

static bool make_room(PlaceObject *self)
{
    int room = self->room ? 2 * self->room : 16;
    Arrival *inbox = PyMem_Realloc(self->inbox, (size_t)room * sizeof *inbox);
    if (inbox == NULL) {
        PyErr_NoMemory();
        return false;
    }
    for (int place = 0; place < self->first; place++) /* what lay at the old beginning goes on at the old end */
        inbox[self->room + place] = inbox[place];
    self->inbox = inbox;
    self->room = room;
    return true;
}

/* Whether a filter lets a frame through: 1 or 0, -1 for an error. */
static int is_accepted(PlaceObject *self, PyObject *frame)
{
    if (!is_there(self->accepts))
        return 1;
    PyObject *arguments[] = {NULL, frame};
    PyObject *said = PyObject_Vectorcall(self->accepts, arguments + 1, 1 | PY_VECTORCALL_ARGUMENTS_OFFSET, NULL);
    int truth = said == NULL ? -1 : PyObject_IsTrue(said);
    forget(&said);
    return truth;
}

/* Put a frame into the inbox, if a filter lets it through and there is room. */
bool keep_frame(PlaceObject *self, PyObject *frame, int64_t at, bool own)
{
    int accepted = is_a(frame, frame_type, "a WireFrame") ? is_accepted(self, frame) : -1;
    if (accepted <= 0)
        return accepted == 0;
    if (self->count >= RECEIVE_QUEUE_MAX) {
        self->overruns++;
        return true;
    }
    if (self->count == self->room && !make_room(self))
        return false;
    int place = (self->first + self->count++) % self->room;
    assert(0 <= place && place < self->room);
    Py_IncRef(frame);
    self->inbox[place] = (Arrival){frame, at, own};
    return true;
}

/* The first of an inbox that holds one; its reference is the caller's. */
Arrival take_arrival(PlaceObject *self)
{
    assert(self->count > 0 && 0 <= self->first && self->first < self->room);
    Arrival arrival = self->inbox[self->first];
    self->first = (self->first + 1) % self->room;
    self->count--;
    return arrival;
}

/* ---- faults ---- */

/* For how long the judge holds a frame, ns; below zero: others go on in its place. False for an error. */
static bool ask_judge(PlaceObject *self, int way, const WireFrame *frame, int64_t now, int64_t *held_ns)
{
    static PyObject *name;
    if (self->fates != NULL) {
        PyObject *judge = another(self->judge); /* Python that it asks may put another one in its place */
        bool judged = fate_of(self->fates, &(JudgedFrame){way, frame->can_id, frame->extended, now}, held_ns);
        Py_DecRef(judge);
        return judged;
    }
    if (name == NULL && (name = PyUnicode_InternFromString("hold")) == NULL)
        return false;
    PyObject *arguments[] = {another(self->judge), PyLong_FromLongLong(way), PyLong_FromLongLong(frame->can_id),
                             PyLong_FromLongLong(now), PyBool_FromLong(frame->extended)};
    bool well = arguments[1] != NULL && arguments[2] != NULL && arguments[3] != NULL;
    PyObject *held = well ? PyObject_VectorcallMethod(name, arguments, 5, NULL) : NULL;
    well = held != NULL && integer(held, held_ns);
    forget(&held);
    for (int place = 0; place < 5; place++)
        forget(&arguments[place]);
    return well;
}

/* What goes on in the place of a lost frame: a tuple of pairs of a frame and its delay. */
static PyObject *ask_replacements(PlaceObject *self, PyObject *frame)
{
    static PyObject *name;
    if (name == NULL && (name = PyUnicode_InternFromString("replacements")) == NULL)
        return NULL;
    PyObject *arguments[] = {another(self->judge), frame};
    PyObject *given = PyObject_VectorcallMethod(name, arguments, 2, NULL);
    Py_DecRef(arguments[0]);
    PyObject *pairs = given == NULL ? NULL : PySequence_Tuple(given);
    forget(&given);
    return pairs;
}

static bool send_object(PlaceObject *self, PyObject *object)
{
    WireFrame frame;
    return read_frame(object, &frame) && send_frame(self->port, &frame);
}

static bool pass_out(PlaceObject *self, PyObject *frame, int64_t now, int64_t delay_ns)
{
    bool kept;
    if (delay_ns == 0)
        return send_object(self, frame);
    return hold_frame(self->held_out, frame, now + delay_ns, 0, &kept)
           && (!kept || let_happen(self->timeline, now + delay_ns, LET_OUT, (PyObject *)self));
}

static bool pass_in(PlaceObject *self, PyObject *frame, int64_t now, int64_t delay_ns)
{
    bool kept;
    if (delay_ns == 0)
        return keep_frame(self, frame, now, false);
    return hold_frame(self->held_in, frame, now + delay_ns, 0, &kept)
           && (!kept || let_happen(self->timeline, now + delay_ns, LET_IN, (PyObject *)self));
}

typedef bool (*Pass)(PlaceObject *, PyObject *, int64_t, int64_t);

static bool pass_replacements(PlaceObject *self, PyObject *frame, int64_t now, Pass pass)
{
    PyObject *pairs = ask_replacements(self, frame);
    if (pairs == NULL)
        return false;
    bool well = true;
    for (Py_ssize_t place = 0; well && place < PyTuple_Size(pairs); place++) {
        PyObject *pair = PySequence_Tuple(PyTuple_GetItem(pairs, place));
        int64_t delay_ns;
        well = pair != NULL && takes(PyTuple_Size(pair), 2, "a replacement")
               && integer(PyTuple_GetItem(pair, 1), &delay_ns)
               && pass(self, PyTuple_GetItem(pair, 0), now, delay_ns);
        forget(&pair);
    }
    Py_DecRef(pairs);
    return well;
}

/* Queue a frame now, or let its fate befall it. */
bool transmit_frame(PlaceObject *self, const WireFrame *frame)
{
    if (!is_there(self->judge))
        return send_frame(self->port, frame);
    int64_t now = self->timeline->now, held_ns;
    if (!ask_judge(self, self->way_out, frame, now, &held_ns))
        return false;
    if (held_ns < 0)
        return pass_replacements(self, frame->object, now, pass_out);
    return held_ns == 0 ? send_frame(self->port, frame) : pass_out(self, frame->object, now, held_ns);
}

/* Another port's frame ended. What a filter keeps out meets no fault. */
bool hear_frame(PlaceObject *self, const WireFrame *frame, int64_t now)
{
    if (!is_there(self->judge))
        return keep_frame(self, frame->object, now, false);
    int64_t held_ns;
    int accepted = is_accepted(self, frame->object);
    if (accepted <= 0)
        return accepted == 0;
    if (!ask_judge(self, self->way_in, frame, now, &held_ns))
        return false;
    if (held_ns < 0)
        return pass_replacements(self, frame->object, now, pass_in);
    return pass_in(self, frame->object, now, held_ns);
}

/* ---- releases ---- */

static PyObject *take_held(HeldObject *self, int64_t now)
{
    bool due = self->heap.count > 0 && self->heap.entries[0].when <= now;
    return due ? take_first(&self->heap).target : NULL;
}

bool let_in(PlaceObject *self, int64_t now)
{
    PyObject *frame = take_held(self->held_in, now);
    bool well = frame == NULL || self->closed || keep_frame(self, frame, now, false);
    forget(&frame);
    return well;
}

/* A controller that is bus-off sends nothing that waited for it. */
bool let_out(PlaceObject *self, int64_t now)
{
    PyObject *frame = take_held(self->held_out, now);
    bool well = frame == NULL || self->port->room == 0 || send_object(self, frame);
    forget(&frame);
    return well;
}
