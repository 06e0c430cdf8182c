/* Python's Stopwatch (native.pyi). */
#define _POSIX_C_SOURCE 199309L /* clock_gettime */
#include <time.h>

#include "objects.h"
#include "types.h"

typedef struct StopwatchObject {
    PyObject head;
    int64_t read_ns;
} StopwatchObject;

static PyObject *call_lap(PyObject *self, PyObject *none)
{
    StopwatchObject *watch = (StopwatchObject *)self;
    struct timespec now;
    (void)none;
    clock_gettime(CLOCK_MONOTONIC, &now);
    int64_t before_ns = watch->read_ns;
    watch->read_ns = (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
    return PyLong_FromLongLong(watch->read_ns - before_ns);
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, 0, 0, "Stopwatch"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    PyObject *lap = self == NULL ? NULL : call_lap(self, NULL);
    if (lap == NULL)
        forget(&self);
    forget(&lap);
    return self;
}

static PyMethodDef methods[] = {
    {"lap", call_lap, METH_NOARGS, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_dealloc, (void *)end_object},
    {Py_tp_methods, methods},
    {0},
};

PyType_Spec stopwatch_spec = {
    .name = "servobench.drivers.core.native.Stopwatch",
    .basicsize = sizeof(StopwatchObject),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = slots,
};
