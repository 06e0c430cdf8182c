/* What the types of this module need of Python: references, calls of what may have an error, the end of an object. */
#ifndef CORE_OBJECTS_H
#define CORE_OBJECTS_H

#include "arguments.h"

static inline int visit_one(PyObject *object, visitproc visit, void *argument)
{
    return object == NULL ? 0 : visit(object, argument);
}

static inline void forget(PyObject **place)
{
    PyObject *object = *place;
    *place = NULL;
    if (object != NULL)
        Py_DecRef(object);
}

static inline PyObject *another(PyObject *object)
{
    Py_IncRef(object);
    return object;
}

static inline bool is_there(const PyObject *object) { return object != NULL && object != Py_None; }

/* Whether a call that gave `result` went well; what it gave is of no interest. */
static inline bool went_well(PyObject *result)
{
    if (result == NULL)
        return false;
    Py_DecRef(result);
    return true;
}

/* Give the memory of an object whose references are gone back, and the reference to its type. */
static inline void end_object(PyObject *self)
{
    PyTypeObject *type = self->type;
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DecRef((PyObject *)type);
}

static inline bool is_a(PyObject *object, PyTypeObject *type, const char *expected)
{
    bool fits = object->type == type || PyType_IsSubtype(object->type, type);
    if (!fits)
        PyErr_Format(PyExc_TypeError, "%s expected", expected);
    return fits;
}

#endif
