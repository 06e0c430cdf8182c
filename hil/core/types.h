/* What the module shows to Python. */
#ifndef CORE_TYPES_H
#define CORE_TYPES_H

#include "frame_row.h"
#include "stable_abi.h"

extern PyType_Spec ring_spec, regular_stream_spec, sink_spec;
extern PyTypeObject *ring_type, *frame_type; /* the frame's is of the core of drivers */

int push_raw_frame(PyObject *ring, const RawFrame *frame);

PyObject *call_frame_row(PyObject *module, PyObject *const *arguments, Py_ssize_t count);

#endif
