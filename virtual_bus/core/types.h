/* The types that the module shows to Python. */
#ifndef CORE_TYPES_H
#define CORE_TYPES_H

#include "stable_abi.h"

extern PyType_Spec inner_loops_spec;
extern PyType_Spec timeline_spec, event_spec, clock_spec;
extern PyType_Spec segment_spec, port_spec, held_spec, place_spec, load_spec;
extern PyType_Spec codec_spec;
extern PyType_Spec device_spec, drive_spec, tpdo_spec, rpdo_spec, sync_spec, timer_spec, device_clock_spec;
extern PyType_Spec seat_spec;
extern PyType_Spec numbers_spec, strike_spec, hold_spec;
extern PyType_Spec hub_end_spec;
extern PyType_Spec queue_spec, route_spec, block_spec, fates_spec;

extern PyTypeObject *frame_type; /* of the core of drivers */

extern PyTypeObject *inner_loops_type;

struct InnerLoops *loops_of(PyObject *self);
int tell_number(PyObject *asked, int64_t *told);
int tell_clock(PyObject *asked, int64_t *told);

#endif
