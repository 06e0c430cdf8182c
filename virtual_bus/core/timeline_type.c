/* Python's Timeline, Event and SimulatedClock (native.pyi). */
#include <stddef.h>

#include "objects.h"
#include "timeline.h"
#include "types.h"

PyTypeObject *timeline_type, *event_type;

static TimelineObject *timeline_of(PyObject *self) { return (TimelineObject *)self; }

static PyObject *make_timeline(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)arguments, (void)names; /* those of a Python class on top of it */
    return PyType_GenericAlloc(type, 0);
}

static int visit_timeline(PyObject *self, visitproc visit, void *argument)
{
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_entries(&timeline_of(self)->heap, visit, argument);
}

static int clear_timeline(PyObject *self)
{
    forget_entries(&timeline_of(self)->heap);
    return 0;
}

static void discard_timeline(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    free_heap(&timeline_of(self)->heap);
    end_object(self);
}

static PyObject *call_call_at(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t when;
    if (!takes(count, 2, "call_at") || !integer(arguments[0], &when))
        return NULL;
    PyObject *event = PyType_GenericAlloc(event_type, 0);
    if (event == NULL)
        return NULL;
    ((EventObject *)event)->callback = another(arguments[1]);
    if (let_happen(timeline_of(self), when, EVENT, event))
        return event;
    Py_DecRef(event);
    return NULL;
}

static PyObject *call_post(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t when;
    if (!takes(count, 2, "post") || !integer(arguments[0], &when))
        return NULL;
    return let_happen(timeline_of(self), when, CALLBACK, arguments[1]) ? nothing() : NULL;
}

static PyObject *call_next_at(PyObject *self, PyObject *none)
{
    (void)none;
    int64_t when;
    return next_event(timeline_of(self), &when) ? PyLong_FromLongLong(when) : nothing();
}

static PyObject *call_step(PyObject *self, PyObject *none)
{
    (void)none;
    int64_t when;
    if (!next_event(timeline_of(self), &when))
        return PyBool_FromLong(0);
    return step(timeline_of(self)) ? PyBool_FromLong(1) : NULL;
}

static PyObject *call_run_until(PyObject *self, PyObject *instant)
{
    int64_t when;
    return integer(instant, &when) && run_until(timeline_of(self), when) ? nothing() : NULL;
}

static PyObject *call_run_until_filled(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t when;
    if (!takes(count, 2, "run_until_filled") || !integer(arguments[0], &when))
        return NULL;
    int filled = run_until_filled(timeline_of(self), when, arguments[1]);
    return filled < 0 ? NULL : PyBool_FromLong(filled);
}

static PyMethodDef timeline_methods[] = {
    {"call_at", (PyCFunction)(void (*)(void))call_call_at, METH_FASTCALL, NULL},
    {"post", (PyCFunction)(void (*)(void))call_post, METH_FASTCALL, NULL},
    {"next_at", call_next_at, METH_NOARGS, NULL},
    {"step", call_step, METH_NOARGS, NULL},
    {"run_until", call_run_until, METH_O, NULL},
    {"run_until_filled", (PyCFunction)(void (*)(void))call_run_until_filled, METH_FASTCALL, NULL},
    {0},
};

static PyMemberDef timeline_members[] = {
    {"now", T_LONGLONG, offsetof(TimelineObject, now), READONLY, NULL},
    {0},
};

static PyType_Slot timeline_slots[] = {
    {Py_tp_new, (void *)make_timeline},
    {Py_tp_traverse, (void *)visit_timeline},
    {Py_tp_clear, (void *)clear_timeline},
    {Py_tp_dealloc, (void *)discard_timeline},
    {Py_tp_methods, timeline_methods},
    {Py_tp_members, timeline_members},
    {0},
};

PyType_Spec timeline_spec = {
    .name = "servobench.virtual_bus.core.native.Timeline",
    .basicsize = sizeof(TimelineObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    .slots = timeline_slots,
};

/* ---- Event ---- */

static int visit_event(PyObject *self, visitproc visit, void *argument)
{
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_one(((EventObject *)self)->callback, visit, argument);
}

static int clear_event(PyObject *self)
{
    forget(&((EventObject *)self)->callback);
    return 0;
}

static void discard_event(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    clear_event(self);
    end_object(self);
}

static PyObject *call_cancel(PyObject *self, PyObject *none)
{
    (void)none;
    clear_event(self);
    return nothing();
}

static PyObject *get_pending(PyObject *self, void *none)
{
    (void)none;
    return PyBool_FromLong(((EventObject *)self)->callback != NULL);
}

static PyMethodDef event_methods[] = {
    {"cancel", call_cancel, METH_NOARGS, NULL},
    {0},
};

static PyGetSetDef event_attributes[] = {
    {"pending", get_pending, NULL, NULL, NULL},
    {0},
};

static PyType_Slot event_slots[] = {
    {Py_tp_traverse, (void *)visit_event},
    {Py_tp_clear, (void *)clear_event},
    {Py_tp_dealloc, (void *)discard_event},
    {Py_tp_methods, event_methods},
    {Py_tp_getset, event_attributes},
    {0},
};

PyType_Spec event_spec = {
    .name = "servobench.virtual_bus.core.native.Event",
    .basicsize = sizeof(EventObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_DISALLOW_INSTANTIATION,
    .slots = event_slots,
};

/* ---- SimulatedClock ---- */

typedef struct ClockObject {
    PyObject head;
    PyObject *timeline;
    PyObject *told; /* the last instant told, as Python's integer; NULL: none yet */
    int64_t told_at;
} ClockObject;

static PyObject *make_clock(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)names;
    if (!takes(PyTuple_Size(arguments), 1, "SimulatedClock")
        || !is_a(PyTuple_GetItem(arguments, 0), timeline_type, "a Timeline"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self != NULL)
        ((ClockObject *)self)->timeline = another(PyTuple_GetItem(arguments, 0));
    return self;
}

static int visit_clock(PyObject *self, visitproc visit, void *argument)
{
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_one(((ClockObject *)self)->timeline, visit, argument);
}

static void discard_clock(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    forget(&((ClockObject *)self)->timeline);
    forget(&((ClockObject *)self)->told);
    end_object(self);
}

/* One instant is asked for some times in a cycle: its integer is made once. */
static PyObject *call_now(PyObject *self, PyObject *none)
{
    ClockObject *clock = (ClockObject *)self;
    int64_t now = timeline_of(clock->timeline)->now;
    (void)none;
    if (clock->told == NULL || clock->told_at != now) {
        PyObject *told = PyLong_FromLongLong(now);
        if (told == NULL)
            return NULL;
        forget(&clock->told);
        clock->told = told;
        clock->told_at = now;
    }
    return another(clock->told);
}

/* By the method of a Python class on top of the timeline, where there is one. */
static PyObject *call_sleep_until(PyObject *self, PyObject *instant)
{
    static PyObject *name;
    PyObject *timeline = ((ClockObject *)self)->timeline;
    if (timeline->type == timeline_type)
        return call_run_until(timeline, instant);
    if (name == NULL && (name = PyUnicode_InternFromString("run_until")) == NULL)
        return NULL;
    PyObject *arguments[] = {timeline, instant};
    return PyObject_VectorcallMethod(name, arguments, 2, NULL);
}

static PyMethodDef clock_methods[] = {
    {"now", call_now, METH_NOARGS, NULL},
    {"sleep_until", call_sleep_until, METH_O, NULL},
    {0},
};

static PyMemberDef clock_members[] = {
    {"timeline", T_OBJECT, offsetof(ClockObject, timeline), READONLY, NULL},
    {0},
};

/* No clear: a circle through a clock goes through its timeline, which has one, and which it is never without. */
static PyType_Slot clock_slots[] = {
    {Py_tp_new, (void *)make_clock},
    {Py_tp_traverse, (void *)visit_clock},
    {Py_tp_dealloc, (void *)discard_clock},
    {Py_tp_methods, clock_methods},
    {Py_tp_members, clock_members},
    {0},
};

PyType_Spec clock_spec = {
    .name = "servobench.virtual_bus.core.native.SimulatedClock",
    .basicsize = sizeof(ClockObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = clock_slots,
};
