/* Attributes of Python's objects, read many times.

   A class that mypyc compiled keeps its own behind getters and setters in C; they are remembered with the class, and
   called without Python's search through dictionaries. Of any other class it is that search. */
#ifndef CORE_ATTRIBUTES_H
#define CORE_ATTRIBUTES_H

#include <string.h>

#include "objects.h"

typedef struct Attribute {
    const char *spelt;
    PyObject *name;
    PyTypeObject *type; /* the last class that has a getter; held, so that no other takes its place in memory */
    PyObject *(*get)(PyObject *, void *);
    int (*set)(PyObject *, PyObject *, void *);
    void *closure;
} Attribute;

/* Remember the getter of this very class; one of a class below it may be hidden by another attribute. */
static inline bool has_getter(Attribute *self, PyTypeObject *type)
{
    const PyGetSetDef *getter = PyType_GetSlot(type, Py_tp_getset);
    for (; getter != NULL && getter->name != NULL; getter++) {
        if (getter->get == NULL || strcmp(getter->name, self->spelt) != 0)
            continue;
        PyTypeObject *before = self->type;
        self->type = (PyTypeObject *)another((PyObject *)type);
        self->get = getter->get;
        self->set = getter->set;
        self->closure = getter->closure;
        if (before != NULL)
            Py_DecRef((PyObject *)before);
        return true;
    }
    return false;
}

static inline PyObject *attribute(Attribute *self, PyObject *object)
{
    if (object->type == self->type || has_getter(self, object->type))
        return self->get(object, self->closure);
    if (self->name == NULL && (self->name = PyUnicode_InternFromString(self->spelt)) == NULL)
        return NULL;
    return PyObject_GetAttr(object, self->name);
}

static inline bool set_attribute(Attribute *self, PyObject *object, PyObject *value)
{
    if ((object->type == self->type || has_getter(self, object->type)) && self->set != NULL)
        return self->set(object, value, self->closure) == 0;
    if (self->name == NULL && (self->name = PyUnicode_InternFromString(self->spelt)) == NULL)
        return false;
    return PyObject_SetAttr(object, self->name, value) == 0;
}

#endif
