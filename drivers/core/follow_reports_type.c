/* Python's FollowReports (native.pyi). */
#include <stddef.h>

#include "follow_reports.h"
#include "statusword.h"
#include "types.h"

PyTypeObject *follow_reports_type;

static FollowReportsObject *reports_of(PyObject *self) { return (FollowReportsObject *)self; }

static bool tell_change(FollowReportsObject *self, int64_t at)
{
    PyObject *argument = PyLong_FromLongLong(at), *changed = another(self->changed);
    bool well = argument != NULL && went_well(PyObject_Vectorcall(changed, &argument, 1, NULL));
    Py_DecRef(changed);
    forget(&argument);
    return well;
}

/* Take in a 6061h that arrived. */
bool follow_mode(FollowReportsObject *self, int64_t shown, int64_t at)
{
    if (shown == self->commanded)
        self->mode_shown = true;
    else if (!self->mode_shown && ++self->older < self->older_max)
        return true;
    if (shown == self->shown)
        return true;
    self->shown = shown;
    self->mode_at = at;
    return tell_change(self, at);
}

/* Take in a 6041h that arrived. */
bool follow_status(FollowReportsObject *self, int64_t statusword, int64_t at)
{
    if (!self->bit || self->shown != self->commanded || (statusword & STATE_BITS) != OPERATION_ENABLED)
        return true;
    bool ignores = false;
    if (statusword & self->bit)
        self->bit_watched = true;
    else
        ignores = self->ignores || (self->bit_watched && !(statusword & INTERNAL_LIMIT_ACTIVE));
    if (ignores == self->ignores)
        return true;
    self->ignores = ignores;
    return tell_change(self, at);
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    int64_t older_max;
    if (!takes_between(arguments, names, 2, 2, "FollowReports") || !integer(PyTuple_GetItem(arguments, 1), &older_max))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    reports_of(self)->changed = another(PyTuple_GetItem(arguments, 0));
    reports_of(self)->older_max = older_max;
    return self;
}

static int visit_reports(PyObject *self, visitproc visit, void *argument)
{
    int result = visit_one((PyObject *)self->type, visit, argument);
    return result ? result : visit_one(reports_of(self)->changed, visit, argument);
}

static int clear_reports(PyObject *self)
{
    PyObject *before = reports_of(self)->changed;
    reports_of(self)->changed = nothing();
    forget(&before);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    forget(&reports_of(self)->changed);
    end_object(self);
}

static PyObject *call_aim(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    FollowReportsObject *reports = reports_of(self);
    int64_t commanded, bit;
    if (!takes(count, 2, "aim") || !integer(arguments[0], &commanded) || !integer(arguments[1], &bit))
        return NULL;
    reports->commanded = reports->shown = commanded;
    reports->bit = bit;
    reports->ignores = reports->mode_shown = reports->bit_watched = false;
    reports->older = 0;
    return nothing();
}

static PyObject *call_end(PyObject *self, PyObject *none)
{
    (void)none;
    reports_of(self)->ignores = reports_of(self)->bit_watched = false;
    return nothing();
}

static PyObject *call_told(PyObject *self, PyObject *const *arguments, Py_ssize_t count,
                           bool (*take)(FollowReportsObject *, int64_t, int64_t))
{
    int64_t told, at;
    if (!takes(count, 2, "told") || !integer(arguments[0], &told) || !integer(arguments[1], &at))
        return NULL;
    return take(reports_of(self), told, at) ? nothing() : NULL;
}

static PyObject *call_mode_told(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    return call_told(self, arguments, count, follow_mode);
}

static PyObject *call_status_told(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    return call_told(self, arguments, count, follow_status);
}

static PyMethodDef methods[] = {
    {"aim", (PyCFunction)(void (*)(void))call_aim, METH_FASTCALL, NULL},
    {"end", call_end, METH_NOARGS, NULL},
    {"mode_told", (PyCFunction)(void (*)(void))call_mode_told, METH_FASTCALL, NULL},
    {"status_told", (PyCFunction)(void (*)(void))call_status_told, METH_FASTCALL, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"shown", T_LONGLONG, offsetof(FollowReportsObject, shown), READONLY, NULL},
    {"mode_at", T_LONGLONG, offsetof(FollowReportsObject, mode_at), READONLY, NULL},
    {"ignores", T_BOOL, offsetof(FollowReportsObject, ignores), READONLY, NULL},
    {"mode_shown", T_BOOL, offsetof(FollowReportsObject, mode_shown), READONLY, NULL},
    {"bit_watched", T_BOOL, offsetof(FollowReportsObject, bit_watched), READONLY, NULL},
    {"lapsed", T_BOOL, offsetof(FollowReportsObject, lapsed), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_reports},
    {Py_tp_clear, (void *)clear_reports},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec follow_reports_spec = {
    .name = "servobench.drivers.core.native.FollowReports",
    .basicsize = sizeof(FollowReportsObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
