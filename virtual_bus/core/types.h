/* The types that the module shows to Python. */
#ifndef CORE_TYPES_H
#define CORE_TYPES_H

#include "stable_abi.h"

extern PyType_Spec inner_loops_spec;

#endif
