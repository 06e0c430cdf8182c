/* Python's CommandWatch (native.pyi). */
#include <stddef.h>

#include "command_watch.h"
#include "objects.h"
#include "types.h"

PyTypeObject *command_watch_type;

enum {
    CYCLES_MAX = 1 << 24, /* an hour of commands at the shortest period, and more */
    /* A ramp shows the same demand for the time of one unit, and for twice that if it is read seldom. */
    RAMP_UNITS = 2,
};
static const int64_t raw_max = (int64_t)1 << 40; /* far beyond every command, of 32 bits and their offset */

static CommandWatch *watch_of(PyObject *self) { return &((CommandWatchObject *)self)->watch; }

static int64_t at_most(int64_t value, int64_t limit) { return value > limit ? limit : value; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    static char *spelt[] = {"cycles", "margin_raw", "equal", "share", "least_raw", "unit_cycles", NULL};
    long long cycles, margin, share = 0, unit_cycles = 0;
    int64_t least = 0;
    int equal = 1;
    PyObject *least_given = Py_None;
    if (!PyArg_ParseTupleAndKeywords(arguments, names, "LL|$pLOL:CommandWatch", spelt, &cycles, &margin, &equal, &share,
                                     &least_given, &unit_cycles)
        || (is_there(least_given) && !integer(least_given, &least)))
        return NULL;
    if (cycles < 2 || cycles > CYCLES_MAX)
        return PyErr_Format(PyExc_ValueError, "commands are watched for at least two cycles, at most %d", CYCLES_MAX);
    if (margin < 0 || share < 0 || least < 0 || unit_cycles < 0)
        return PyErr_Format(PyExc_ValueError, "a margin, share, least speed or ramp below 0");
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    int64_t half = cycles / 2, ramp = RAMP_UNITS * at_most(unit_cycles, raw_max);
    int64_t *rooms = PyMem_Realloc(NULL, 2 * (size_t)half * sizeof *rooms);
    if (rooms == NULL) {
        Py_DecRef(self);
        return PyErr_NoMemory();
    }
    *watch_of(self) = (CommandWatch){
        .half = half,
        .margin = at_most(margin, raw_max),
        .share = share,
        .least = at_most(least, raw_max),
        .stays_for = ramp > half ? ramp : half,
        .equal = equal != 0,
        .has_least = is_there(least_given),
        .recent = rooms,
        .ways = rooms + half,
        .newest = -1,
        .changed = -1,
        .follows = true,
    };
    return self;
}

static void discard(PyObject *self)
{
    PyMem_Free(watch_of(self)->recent);
    end_object(self);
}

/* A value that a drive tells, or is sent. */
bool is_told(PyObject *object, int64_t *raw)
{
    if (!integer(object, raw))
        return false;
    bool fits = -raw_max <= *raw && *raw <= raw_max;
    if (!fits)
        PyErr_Format(PyExc_ValueError, "a value of a drive expected, %lld was given", (long long)*raw);
    return fits;
}

static PyObject *call_sent(PyObject *self, PyObject *raw)
{
    int64_t value;
    if (!is_told(raw, &value))
        return NULL;
    command_sent(watch_of(self), value);
    return nothing();
}

static PyObject *call_excuse(PyObject *self, PyObject *none)
{
    (void)none;
    command_excused(watch_of(self));
    return nothing();
}

static PyObject *call_told(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t raw;
    if (count < 1 || count > 2)
        return PyErr_Format(PyExc_TypeError, "told() takes 1 or 2 arguments, %zd were given", count);
    int limited = count == 2 ? PyObject_IsTrue(arguments[1]) : 0;
    if (limited < 0 || !is_told(arguments[0], &raw))
        return NULL;
    command_told(watch_of(self), raw, limited != 0);
    return nothing();
}

static PyMethodDef methods[] = {
    {"sent", call_sent, METH_O, NULL},
    {"excuse", call_excuse, METH_NOARGS, NULL},
    {"told", (PyCFunction)(void (*)(void))call_told, METH_FASTCALL, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"follows", T_BOOL, offsetof(CommandWatchObject, watch.follows), READONLY, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec command_watch_spec = {
    .name = "servobench.drivers.core.native.CommandWatch",
    .basicsize = sizeof(CommandWatchObject),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = slots,
};
