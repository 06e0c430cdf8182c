/* The types that the module shows to Python. */
#ifndef CORE_TYPES_H
#define CORE_TYPES_H

#include "stable_abi.h"

extern PyType_Spec inner_loops_spec;
extern PyType_Spec timeline_spec, event_spec, clock_spec;
extern PyType_Spec segment_spec, port_spec, held_spec, place_spec, load_spec;
extern PyType_Spec codec_spec;
extern PyType_Spec numbers_spec, strike_spec, hold_spec;
extern PyType_Spec queue_spec, route_spec, block_spec, fates_spec;

extern PyTypeObject *frame_type; /* of the core of drivers */

int tell_number(PyObject *asked, int64_t *told);

#endif
