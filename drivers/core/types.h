/* The types that the module shows to Python. */
#ifndef CORE_TYPES_H
#define CORE_TYPES_H

#include "stable_abi.h"

extern PyType_Spec frame_spec, link_spec, pump_spec;
extern PyTypeObject *frame_type, *link_type;

PyObject *call_nearest(PyObject *module, PyObject *value);
PyObject *call_data_frame(PyObject *module, PyObject *const *arguments, Py_ssize_t count);

#endif
