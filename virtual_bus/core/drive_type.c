/* Python's CyclicDrive (native.pyi): a drive's inner loops carried along, and its statusword. */
#include <stddef.h>

#include "attributes.h"
#include "device.h"
#include "types.h"

PyTypeObject *drive_type;

enum {
    HELD_COUNT = 6,
    CALLABLES_FIRST = 3, /* of these, as many as are callables */
    INTERNAL_LIMIT_ACTIVE = 1 << 11, /* of the statusword (CiA 402-2, 6041h) */
};

static DriveObject *drive_of(PyObject *self) { return (DriveObject *)self; }

static void places_of(DriveObject *self, PyObject **places[HELD_COUNT])
{
    places[0] = &self->loops;
    places[1] = &self->statusword;
    places[2] = &self->shown;
    places[3] = &self->run_mode;
    places[4] = &self->stop_on;
    places[5] = &self->tell_protection;
}

static bool call_bare(PyObject *callable) { return went_well(PyObject_Vectorcall(callable, NULL, 0, NULL)); }

/* The cyclic values as of the last inner tick. */
static bool refresh(DriveObject *self)
{
    static Attribute value = {.spelt = "value"};
    bool limited = loops_of(self->loops)->state.limited != 0.0;
    int64_t status = limited ? self->base_status | INTERNAL_LIMIT_ACTIVE : self->base_status;
    if (self->shown == NULL || status != self->shown_status) {
        PyObject *before = self->shown;
        self->shown = PyLong_FromLongLong(status);
        self->shown_status = status;
        forget(&before);
    }
    if (self->shown == NULL)
        return false;
    PyObject *shown = another(self->shown);
    bool well = set_attribute(&value, self->statusword, shown);
    Py_DecRef(shown);
    if (!well)
        return false;
    return !self->protects || call_bare(self->tell_protection);
}

/* Motion period by motion period, as long as a mode is followed: 1; 0 if none is any more, -1 for an error. */
static int run_mode(DriveObject *self, int64_t now)
{
    PyObject *argument = PyLong_FromLongLong(now);
    PyObject *said = argument == NULL ? NULL : PyObject_Vectorcall(self->run_mode, &argument, 1, NULL);
    int followed = said == NULL ? -1 : PyObject_IsTrue(said);
    forget(&said);
    forget(&argument);
    return followed;
}

bool advance_drive(DriveObject *self, int64_t now)
{
    if (self->tasked) {
        int followed = run_mode(self, now);
        if (followed != 0)
            return followed > 0;
    }
    if (!advance_to(loops_of(self->loops), now)) {
        if (self->wake_at <= now)
            self->wake_at = now + MILLISECOND_NS;
        return true;
    }
    if (self->stopping) {
        if (!call_bare(self->stop_on))
            return false;
        self->wake_at = now + MILLISECOND_NS;
    } else {
        self->wake_at = now + self->wake_ns;
    }
    return refresh(self);
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, 5, 5, "CyclicDrive")
        || !is_a(PyTuple_GetItem(arguments, 0), inner_loops_type, "an InnerLoops"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    drive_of(self)->loops = another(PyTuple_GetItem(arguments, 0));
    drive_of(self)->statusword = another(PyTuple_GetItem(arguments, 1));
    drive_of(self)->run_mode = another(PyTuple_GetItem(arguments, 2));
    drive_of(self)->stop_on = another(PyTuple_GetItem(arguments, 3));
    drive_of(self)->tell_protection = another(PyTuple_GetItem(arguments, 4));
    return self;
}

static int visit_drive(PyObject *self, visitproc visit, void *argument)
{
    PyObject **places[HELD_COUNT];
    places_of(drive_of(self), places);
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_each(places, HELD_COUNT, visit, argument);
}

/* Loops and variable stay: they are counted on. */
static int clear_drive(PyObject *self)
{
    PyObject **places[HELD_COUNT];
    places_of(drive_of(self), places);
    for (int which = CALLABLES_FIRST; which < HELD_COUNT; which++) {
        PyObject *before = *places[which];
        *places[which] = nothing();
        forget(&before);
    }
    return 0;
}

static void discard(PyObject *self)
{
    PyObject **places[HELD_COUNT];
    PyObject_GC_UnTrack(self);
    places_of(drive_of(self), places);
    forget_each(places, HELD_COUNT);
    end_object(self);
}

static PyObject *call_advance(PyObject *self, PyObject *now)
{
    int64_t now_ns;
    return integer(now, &now_ns) && advance_drive(drive_of(self), now_ns) ? nothing() : NULL;
}

static PyObject *call_refresh(PyObject *self, PyObject *none)
{
    (void)none;
    return refresh(drive_of(self)) ? nothing() : NULL;
}

static PyMethodDef methods[] = {
    {"advance", call_advance, METH_O, NULL},
    {"refresh", call_refresh, METH_NOARGS, NULL},
    {0},
};

#define PLACE(path) offsetof(DriveObject, path)

static PyMemberDef members[] = {
    {"base_status", T_LONGLONG, PLACE(base_status), 0, NULL},
    {"wake_at", T_LONGLONG, PLACE(wake_at), 0, NULL},
    {"wake_ns", T_LONGLONG, PLACE(wake_ns), 0, NULL},
    {"tasked", T_BOOL, PLACE(tasked), 0, NULL},
    {"stopping", T_BOOL, PLACE(stopping), 0, NULL},
    {"protects", T_BOOL, PLACE(protects), 0, NULL},
    {"awaits_sync", T_BOOL, PLACE(awaits_sync), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_drive},
    {Py_tp_clear, (void *)clear_drive},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec drive_spec = {
    .name = "servobench.virtual_bus.core.native.CyclicDrive",
    .basicsize = sizeof(DriveObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
