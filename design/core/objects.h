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

/* The places in which an object holds others; NULL at a place: nothing. */
static inline int visit_each(PyObject **const *places, size_t count, visitproc visit, void *argument)
{
    int result = 0;
    for (size_t which = 0; result == 0 && which < count; which++)
        result = visit_one(*places[which], visit, argument);
    return result;
}

static inline void forget_each(PyObject **const *places, size_t count)
{
    for (size_t which = 0; which < count; which++)
        forget(places[which]);
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

/* Whether a class on top of `base` has a method of its own in the place of one of `base`: 1, 0, or -1 for an error. */
static inline int is_overridden(PyTypeObject *type, PyTypeObject *base, const char *method)
{
    if (type == base)
        return 0;
    PyObject *name = PyUnicode_InternFromString(method);
    if (name == NULL)
        return -1;
    PyObject *own = PyObject_GetAttr((PyObject *)type, name);
    PyObject *original = PyObject_GetAttr((PyObject *)base, name);
    int result = own == NULL || original == NULL ? -1 : own != original;
    forget(&own);
    forget(&original);
    Py_DecRef(name);
    return result;
}

/* Whether a method without keywords got between `least` and `most` arguments. */
static inline bool takes_between(PyObject *arguments, PyObject *names, Py_ssize_t least, Py_ssize_t most,
                                 const char *name)
{
    Py_ssize_t given = PyTuple_Size(arguments);
    bool well = least <= given && given <= most && (names == NULL || PyObject_Size(names) == 0);
    if (!well)
        PyErr_Format(PyExc_TypeError, "%s() takes %zd to %zd arguments without keywords, %zd were given", name, least,
                     most, given);
    return well;
}

/* Show a type in `module`; `*place` is it, with a reference as long as the process is there. */
static inline bool add_type(PyObject *module, const char *name, PyType_Spec *spec, PyTypeObject **place)
{
    *place = (PyTypeObject *)PyType_FromSpec(spec);
    return *place != NULL && PyModule_AddObjectRef(module, name, (PyObject *)*place) == 0;
}

#endif
