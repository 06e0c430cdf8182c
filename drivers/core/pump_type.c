/* Python's Pump (native.pyi): hands frames from a link to their handlers, and has housekeeping done when due. */
#include <stddef.h>

#include "inlet.h"
#include "link.h"
#include "set_point_frame.h"
#include "types.h"

enum { ARGUMENT_COUNT = 7 };

typedef struct PumpObject {
    PyObject head;
    LinkObject *link;
    PyObject *handlers, *echo_handlers; /* dictionaries by identifier */
    PyObject *others, *keep_house, *now, *sleep_until;
    int64_t housekeeping_at;
} PumpObject;

static const int64_t never = ((int64_t)1 << 62) - 1; /* servobench.drivers.timebase.NEVER */

static PumpObject *pump_of(PyObject *self) { return (PumpObject *)self; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, ARGUMENT_COUNT, ARGUMENT_COUNT, "Pump")
        || !is_a(PyTuple_GetItem(arguments, 0), link_type, "a Link")
        || !is_a(PyTuple_GetItem(arguments, 1), &PyDict_Type, "a dictionary")
        || !is_a(PyTuple_GetItem(arguments, 2), &PyDict_Type, "a dictionary"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    PumpObject *pump = pump_of(self);
    pump->link = (LinkObject *)another(PyTuple_GetItem(arguments, 0));
    PyObject **held[] = {&pump->handlers, &pump->echo_handlers, &pump->others,
                         &pump->keep_house, &pump->now, &pump->sleep_until};
    for (int which = 0; which < ARGUMENT_COUNT - 1; which++)
        *held[which] = another(PyTuple_GetItem(arguments, which + 1));
    pump->housekeeping_at = never;
    return self;
}

static int visit_pump(PyObject *self, visitproc visit, void *argument)
{
    PumpObject *pump = pump_of(self);
    PyObject *held[] = {(PyObject *)self->type, (PyObject *)pump->link, pump->handlers, pump->echo_handlers,
                        pump->others, pump->keep_house, pump->now, pump->sleep_until};
    int result = 0;
    for (size_t which = 0; result == 0 && which < sizeof held / sizeof *held; which++)
        result = visit_one(held[which], visit, argument);
    return result;
}

/* What it pumps with stays until the end: only where the callables lead is cut off. */
static int clear_pump(PyObject *self)
{
    PumpObject *pump = pump_of(self);
    PyObject **held[] = {&pump->others, &pump->keep_house, &pump->now, &pump->sleep_until};
    for (size_t which = 0; which < sizeof held / sizeof *held; which++) {
        PyObject *before = *held[which];
        *held[which] = nothing();
        forget(&before);
    }
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    PumpObject *pump = pump_of(self);
    PyObject *held[] = {(PyObject *)pump->link, pump->handlers, pump->echo_handlers, pump->others,
                        pump->keep_house, pump->now, pump->sleep_until};
    for (size_t which = 0; which < sizeof held / sizeof *held; which++)
        forget(&held[which]);
    end_object(self);
}

static bool call_with(PyObject *callable, PyObject **arguments, size_t count)
{
    PyObject *held = another(callable); /* what it does may put another one in its place */
    bool well = went_well(PyObject_Vectorcall(held, arguments, count, NULL));
    Py_DecRef(held);
    return well;
}

static bool call_at(PyObject *callable, int64_t at)
{
    PyObject *arguments[] = {PyLong_FromLongLong(at)};
    bool well = arguments[0] != NULL && call_with(callable, arguments, 1);
    forget(&arguments[0]);
    return well;
}

/* The echoes of an RPDO, and a TPDO's inlet, are C: no object is made of an instant. */
static bool dispatch_own_pdo(PyObject *handler, const FrameObject *frame, int64_t at)
{
    SetPointFrameObject *sent = (SetPointFrameObject *)another(handler);
    bool well = take_echo(&sent->awaited, frame->data, at, frame->handed_at);
    Py_DecRef((PyObject *)sent);
    return well;
}

/* An echo without a handler goes nowhere. */
static bool dispatch_echo(PumpObject *self, const FrameObject *frame, PyObject *can_id, int64_t at)
{
    PyObject *handler = PyDict_GetItemWithError(self->echo_handlers, can_id);
    if (handler == NULL)
        return !PyErr_Occurred();
    if (handler->type == set_point_frame_type)
        return dispatch_own_pdo(handler, frame, at);
    PyObject *arguments[] = {frame->data, PyLong_FromLongLong(at), PyLong_FromLongLong(frame->handed_at)};
    bool well = arguments[1] != NULL && arguments[2] != NULL && call_with(handler, arguments, 3);
    forget(&arguments[2]);
    forget(&arguments[1]);
    return well;
}

static bool dispatch_pdo(PyObject *handler, const FrameObject *frame, int64_t at)
{
    InletObject *inlet = (InletObject *)another(handler);
    bool well = take_pdo(inlet, frame->data, at);
    Py_DecRef((PyObject *)inlet);
    return well;
}

static bool dispatch_frame(PumpObject *self, const FrameObject *frame, PyObject *can_id, int64_t at)
{
    PyObject *handler = PyDict_GetItemWithError(self->handlers, can_id);
    if (handler == NULL && PyErr_Occurred())
        return false;
    if (handler != NULL && handler->type == inlet_type)
        return dispatch_pdo(handler, frame, at);
    PyObject *arguments[] = {can_id, frame->data, PyLong_FromLongLong(at)};
    bool well = arguments[2] != NULL
                && (handler == NULL ? call_with(self->others, arguments, 3) : call_with(handler, arguments + 1, 2));
    forget(&arguments[2]);
    return well;
}

/* The link's last frame, to whom it belongs; it is held, as what is called may fetch the next one. */
static bool dispatch(PumpObject *self)
{
    FrameObject *frame = (FrameObject *)another((PyObject *)self->link->last);
    PyObject *can_id = identifier(frame->can_id);
    bool well = can_id != NULL
                && (self->link->last_own ? dispatch_echo : dispatch_frame)(self, frame, can_id, self->link->last_at);
    forget(&can_id);
    Py_DecRef((PyObject *)frame);
    return well;
}

/* Housekeeping that is due, at `due`, before a frame came. */
static bool keep_house(PumpObject *self, int64_t due)
{
    int64_t now;
    PyObject *read = PyObject_Vectorcall(self->now, NULL, 0, NULL);
    bool well = read != NULL && integer(read, &now) && call_at(self->keep_house, now > due ? now : due);
    forget(&read);
    if (well && self->housekeeping_at <= due) { /* as where other code has taken its place */
        PyErr_Format(PyExc_RuntimeError, "housekeeping that was due has not been done");
        well = false;
    }
    return well;
}

/* Handle the next frame: 1; 0 once `until` has come without one, -1 for an error. */
static int pump_one(PumpObject *self, int64_t until)
{
    for (;;) {
        int64_t due = self->housekeeping_at;
        int fetched = fetch(self->link, until < due ? until : due);
        if (fetched < 0)
            return -1;
        if (fetched) {
            int64_t at = self->link->last_at;
            bool well = dispatch(self) && (at < self->housekeeping_at || call_at(self->keep_house, at));
            return well ? 1 : -1;
        }
        if (due > until)
            return 0;
        if (!keep_house(self, due))
            return -1;
    }
}

static bool pump(PumpObject *self, int64_t until)
{
    int handled;
    do {
        handled = pump_one(self, until);
    } while (handled > 0);
    return handled == 0;
}

static bool rest(PumpObject *self, int64_t until)
{
    int watched = needs_watching(self->link);
    if (watched < 0)
        return false;
    while (!watched && self->housekeeping_at < until) {
        int64_t due = self->housekeeping_at;
        if (!call_at(self->sleep_until, due) || !pump(self, due))
            return false;
    }
    return (watched || call_at(self->sleep_until, until)) && pump(self, until);
}

static bool begins(PumpObject *self, PyObject *until, int64_t *until_ns)
{
    if (self->link->port == NULL)
        PyErr_Format(PyExc_ValueError, "the link has no port yet");
    return self->link->port != NULL && integer(until, until_ns);
}

static PyObject *call_pump_one(PyObject *self, PyObject *until)
{
    int64_t until_ns;
    int handled = begins(pump_of(self), until, &until_ns) ? pump_one(pump_of(self), until_ns) : -1;
    return handled < 0 ? NULL : PyBool_FromLong(handled);
}

static PyObject *call_pump(PyObject *self, PyObject *until)
{
    int64_t until_ns;
    return begins(pump_of(self), until, &until_ns) && pump(pump_of(self), until_ns) ? nothing() : NULL;
}

static PyObject *call_rest(PyObject *self, PyObject *until)
{
    int64_t until_ns;
    return begins(pump_of(self), until, &until_ns) && rest(pump_of(self), until_ns) ? nothing() : NULL;
}

static PyMethodDef methods[] = {
    {"pump_one", call_pump_one, METH_O, NULL},
    {"pump", call_pump, METH_O, NULL},
    {"rest", call_rest, METH_O, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"housekeeping_at", T_LONGLONG, offsetof(PumpObject, housekeeping_at), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_pump},
    {Py_tp_clear, (void *)clear_pump},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec pump_spec = {
    .name = "servobench.drivers.core.native.Pump",
    .basicsize = sizeof(PumpObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
