/* Python's Reception and LastStatusword (native.pyi). */
#include <stddef.h>

#include "reception.h"
#include "types.h"
#include "whole_numbers.h"

PyTypeObject *reception_type, *last_statusword_type;

enum {
    NS_PER_US = 1000,
    /* A stamp further than this from the previous one means a clock that was set, or a long silence: the speed says
       nothing about the way in between. A bench tolerates fewer lost readings in a row. */
    REACH_PERIODS = 64,
    STAMP_BITS_MAX = 32,
};
static const int64_t longest_ns = 1000000000; /* of a period, and of a count of a stamp */
static const double no_number = __builtin_nan("");

static LastStatuswordObject *statusword_of(PyObject *self) { return (LastStatuswordObject *)self; }

static PyObject *make_statusword(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, 0, 0, "LastStatusword"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self != NULL)
        statusword_of(self)->statusword = statusword_of(self)->at = statusword_of(self)->by_pdo = NEVER_TOLD;
    return self;
}

static PyObject *call_take(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t statusword, at;
    if (!takes(count, 2, "take") || !integer(arguments[0], &statusword) || !integer(arguments[1], &at))
        return NULL;
    statusword_of(self)->statusword = statusword;
    statusword_of(self)->at = at;
    return nothing();
}

static PyObject *call_expect(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t bits, wanted, silence_ns;
    if (!takes(count, 3, "expect") || !integer(arguments[0], &bits) || !integer(arguments[1], &wanted)
        || !integer(arguments[2], &silence_ns))
        return NULL;
    statusword_of(self)->bits = bits;
    statusword_of(self)->wanted = wanted;
    statusword_of(self)->silence_ns = silence_ns;
    return nothing();
}

static PyObject *call_as_expected(PyObject *self, PyObject *now)
{
    const LastStatuswordObject *told = statusword_of(self);
    int64_t now_ns;
    if (!integer(now, &now_ns))
        return NULL;
    return PyBool_FromLong((told->statusword & told->bits) == told->wanted
                           && minus(now_ns, told->at) <= told->silence_ns);
}

static PyMethodDef statusword_methods[] = {
    {"expect", (PyCFunction)(void (*)(void))call_expect, METH_FASTCALL, NULL},
    {"as_expected", call_as_expected, METH_O, NULL},
    {"take", (PyCFunction)(void (*)(void))call_take, METH_FASTCALL, NULL},
    {0},
};

static PyMemberDef statusword_members[] = {
    {"statusword", T_LONGLONG, offsetof(LastStatuswordObject, statusword), READONLY, NULL},
    {"at", T_LONGLONG, offsetof(LastStatuswordObject, at), READONLY, NULL},
    {"by_pdo", T_LONGLONG, offsetof(LastStatuswordObject, by_pdo), READONLY, NULL},
    {0},
};

static PyType_Slot statusword_slots[] = {
    {Py_tp_new, (void *)make_statusword},
    {Py_tp_dealloc, (void *)end_object},
    {Py_tp_methods, statusword_methods},
    {Py_tp_members, statusword_members},
    {0},
};

PyType_Spec last_statusword_spec = {
    .name = "servobench.drivers.core.native.LastStatusword",
    .basicsize = sizeof(LastStatuswordObject),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = statusword_slots,
};

static ReceptionObject *reception_of(PyObject *self) { return (ReceptionObject *)self; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    static char *spelt[] = {"velocity_rad_s", "torque_nm", "position_rad", "period_ns", "stamp_bits", "count_ns",
                            "leads",          "stamped",   "told",         "follow",    "syncs",      NULL};
    Reception state = {.torque_nm = no_number, .torque_told_at = NEVER_TOLD, .position_told_at = NEVER_TOLD,
                       .last_at = NEVER_TOLD, .anchored_at = NEVER_TOLD};
    long long period_ns, count_ns;
    int leads, stamped;
    PyObject *told, *follow, *syncs;
    if (!PyArg_ParseTupleAndKeywords(arguments, names, "dddLiLppOOO:Reception", spelt, &state.rad_s_per_raw,
                                     &state.nm_per_raw, &state.rad_per_count, &period_ns, &state.stamp_bits, &count_ns,
                                     &leads, &stamped, &told, &follow, &syncs)
        || !is_a(told, last_statusword_type, "a LastStatusword")
        || !is_a(follow, follow_reports_type, "FollowReports"))
        return NULL;
    if (period_ns < 1 || period_ns > longest_ns || count_ns < 1 || count_ns > longest_ns || state.stamp_bits < 1
        || state.stamp_bits > STAMP_BITS_MAX)
        return PyErr_Format(PyExc_ValueError,
                            "a period of %lld ns, and stamps of %d bits that count %lld ns: 1 ns to 1 s, and at most"
                            " %d bits expected",
                            period_ns, state.stamp_bits, count_ns, STAMP_BITS_MAX);
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    state.period_ns = period_ns;
    state.period_us = period_ns < NS_PER_US ? 1 : period_ns / NS_PER_US;
    state.reach_us = REACH_PERIODS * state.period_us;
    state.count_ns = count_ns;
    state.leads = leads != 0;
    state.stamped = stamped != 0;
    ReceptionObject *reception = reception_of(self);
    reception->state = state;
    reception->told = (LastStatuswordObject *)another(told);
    reception->follow = (FollowReportsObject *)another(follow);
    reception->syncs = another(syncs);
    reception->watch = nothing();
    PyObject **rows[] = {&reception->readings, &reception->readbacks, &reception->changes};
    for (size_t which = 0; which < sizeof rows / sizeof *rows; which++)
        if ((*rows[which] = PyList_New(0)) == NULL) {
            Py_DecRef(self);
            return NULL;
        }
    return self;
}

/* What it receives with stays until the end. */
static int visit_reception(PyObject *self, visitproc visit, void *argument)
{
    ReceptionObject *reception = reception_of(self);
    PyObject *held[] = {(PyObject *)self->type, (PyObject *)reception->follow, reception->syncs,
                        reception->readings,    reception->readbacks,          reception->changes};
    int result = 0;
    for (size_t which = 0; result == 0 && which < sizeof held / sizeof *held; which++)
        result = visit_one(held[which], visit, argument);
    return result;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    ReceptionObject *reception = reception_of(self);
    PyObject *held[] = {(PyObject *)reception->told, (PyObject *)reception->follow, reception->syncs,
                        reception->watch,            reception->readings,           reception->readbacks,
                        reception->changes};
    for (size_t which = 0; which < sizeof held / sizeof *held; which++)
        forget(&held[which]);
    end_object(self);
}

static PyObject *call_anchor(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t raw, at;
    if (!takes(count, 2, "anchor_position") || !integer(arguments[0], &raw) || !integer(arguments[1], &at))
        return NULL;
    return anchor_position(reception_of(self), raw, at) ? nothing() : NULL;
}

static PyObject *call_position_rad(PyObject *self, PyObject *raw)
{
    int64_t value;
    if (is_there(raw) && !integer(raw, &value))
        return NULL;
    return PyFloat_FromDouble(position_rad(&reception_of(self)->state, is_there(raw) ? &value : NULL));
}

static PyObject *call_tell_watch(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t raw;
    if (!takes(count, 2, "tell_watch") || !is_a(arguments[0], command_watch_type, "a CommandWatch")
        || !is_told(arguments[1], &raw))
        return NULL;
    tell_watch(reception_of(self), &((CommandWatchObject *)arguments[0])->watch, raw);
    return nothing();
}

static PyObject *get_watch(PyObject *self, void *none)
{
    (void)none;
    return another(reception_of(self)->watch);
}

static int set_watch(PyObject *self, PyObject *watch, void *none)
{
    (void)none;
    if (is_there(watch) && !is_a(watch, command_watch_type, "a CommandWatch"))
        return -1;
    PyObject *before = reception_of(self)->watch;
    reception_of(self)->watch = watch == NULL ? nothing() : another(watch);
    forget(&before);
    return 0;
}

static PyMethodDef methods[] = {
    {"anchor_position", (PyCFunction)(void (*)(void))call_anchor, METH_FASTCALL, NULL},
    {"position_rad", call_position_rad, METH_O, NULL},
    {"tell_watch", (PyCFunction)(void (*)(void))call_tell_watch, METH_FASTCALL, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"readings", T_OBJECT, offsetof(ReceptionObject, readings), READONLY, NULL},
    {"readbacks", T_OBJECT, offsetof(ReceptionObject, readbacks), READONLY, NULL},
    {"changes", T_OBJECT, offsetof(ReceptionObject, changes), READONLY, NULL},
    {"malformed", T_LONGLONG, offsetof(ReceptionObject, state.malformed), READONLY, NULL},
    {"readings_made", T_LONGLONG, offsetof(ReceptionObject, state.readings_made), READONLY, NULL},
    {"torque_nm", T_DOUBLE, offsetof(ReceptionObject, state.torque_nm), READONLY, NULL},
    {"torque_told_at", T_LONGLONG, offsetof(ReceptionObject, state.torque_told_at), READONLY, NULL},
    {"position_told_at", T_LONGLONG, offsetof(ReceptionObject, state.position_told_at), READONLY, NULL},
    {0},
};

static PyGetSetDef getters[] = {
    {"watch", get_watch, set_watch, NULL, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_reception},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {Py_tp_getset, getters},
    {0},
};

PyType_Spec reception_spec = {
    .name = "servobench.drivers.core.native.Reception",
    .basicsize = sizeof(ReceptionObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
