/* The types that the module shows to Python. */
#ifndef CORE_TYPES_H
#define CORE_TYPES_H

#include "stable_abi.h"

extern PyType_Spec frame_spec, link_spec, pump_spec;
extern PyType_Spec command_watch_spec, follow_reports_spec, inlet_spec, last_statusword_spec, reception_spec, set_point_frame_spec;
extern PyType_Spec stopwatch_spec;
extern PyTypeObject *frame_type, *link_type;
extern PyTypeObject *command_watch_type, *follow_reports_type, *last_statusword_type;

PyObject *call_nearest(PyObject *module, PyObject *value);
PyObject *call_data_frame(PyObject *module, PyObject *const *arguments, Py_ssize_t count);

#endif
