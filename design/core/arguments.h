/* Python's arguments as C's values; false, with the error set, for what is none. */
#ifndef CORE_ARGUMENTS_H
#define CORE_ARGUMENTS_H

#include <stdbool.h>

#include "stable_abi.h"

static inline bool takes(Py_ssize_t given, Py_ssize_t expected, const char *name)
{
    if (given != expected)
        PyErr_Format(PyExc_TypeError, "%s() takes %zd arguments, %zd were given", name, expected, given);
    return given == expected;
}

static inline bool integer(PyObject *object, int64_t *value)
{
    /* Of numbers above 30 bits, as instants are, PyLong_AsLong takes a third of the time. */
    *value = sizeof(long) == sizeof *value ? PyLong_AsLong(object) : PyLong_AsLongLong(object);
    return *value != -1 || !PyErr_Occurred();
}

static inline bool number(PyObject *object, double *value)
{
    *value = PyFloat_AsDouble(object);
    return *value != -1.0 || !PyErr_Occurred();
}

static inline bool numbers(PyObject *const *objects, double *values, int count)
{
    for (int k = 0; k < count; k++)
        if (!number(objects[k], &values[k]))
            return false;
    return true;
}

/* Octets that are `*count` doubles in this machine's order. */
static inline bool doubles(PyObject *object, const double **values, Py_ssize_t *count)
{
    char *octets;
    Py_ssize_t length;
    if (PyBytes_AsStringAndSize(object, &octets, &length) < 0)
        return false;
    if (length % (Py_ssize_t)sizeof(double)) {
        PyErr_Format(PyExc_ValueError, "%zd octets: whole doubles expected", length);
        return false;
    }
    *values = (const double *)octets;
    *count = length / (Py_ssize_t)sizeof(double);
    return true;
}

/* A whole number, of at most 63 bits where it is finite, as Python's. */
static inline PyObject *whole(double value)
{
    if (value - value == 0.0)
        return PyLong_FromLongLong((long long)value);
    return PyErr_Format(PyExc_ValueError, "infinite or no number: a finite one expected");
}

static inline PyObject *nothing(void)
{
    Py_IncRef(Py_None);
    return Py_None;
}

#endif
