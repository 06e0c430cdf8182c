/* Python's BusLoad (native.pyi). */
#include <stddef.h>

#include "bus_load.h"
#include "objects.h"
#include "types.h"

PyTypeObject *load_type;

static BusLoad *load_of(PyObject *self) { return &((LoadObject *)self)->load; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)names;
    PyObject *self = takes(PyTuple_Size(arguments), 0, "BusLoad") ? PyType_GenericAlloc(type, 0) : NULL;
    if (self != NULL)
        start_load(load_of(self));
    return self;
}

static void discard(PyObject *self) { end_object(self); }

static PyObject *call_add(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t duration_ns, end;
    if (!takes(count, 2, "add") || !integer(arguments[0], &duration_ns) || !integer(arguments[1], &end))
        return NULL;
    add_load(load_of(self), duration_ns, end);
    return nothing();
}

static PyObject *call_busy_until(PyObject *self, PyObject *instant)
{
    int64_t when;
    return integer(instant, &when) ? PyLong_FromLongLong(busy_until(load_of(self), when)) : NULL;
}

static PyObject *call_percent(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t since, until;
    if (!takes(count, 2, "percent") || !integer(arguments[0], &since) || !integer(arguments[1], &until))
        return NULL;
    return PyFloat_FromDouble(load_percent(load_of(self), since, until));
}

static PyMethodDef methods[] = {
    {"add", (PyCFunction)(void (*)(void))call_add, METH_FASTCALL, NULL},
    {"busy_until", call_busy_until, METH_O, NULL},
    {"percent", (PyCFunction)(void (*)(void))call_percent, METH_FASTCALL, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"busy_ns", T_LONGLONG, offsetof(LoadObject, load.busy_ns), READONLY, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec load_spec = {
    .name = "servobench.virtual_bus.core.native.BusLoad",
    .basicsize = sizeof(LoadObject),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = slots,
};
