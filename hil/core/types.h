/* What the module shows to Python. */
#ifndef CORE_TYPES_H
#define CORE_TYPES_H

#include "stable_abi.h"

extern PyType_Spec ring_spec, regular_stream_spec;

PyObject *call_frame_row(PyObject *module, PyObject *const *arguments, Py_ssize_t count);

#endif
