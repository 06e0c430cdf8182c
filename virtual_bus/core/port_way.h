/* The attribute `way` and the methods `receive` and `transmit` of a type that has a way in C. */
#ifndef CORE_PORT_WAY_H
#define CORE_PORT_WAY_H

#include "frames.h"

PyObject *show_way(PyObject *self, void *way);
PyObject *receive_by(const PortWay *way, PyObject *self, PyObject *until);
PyObject *transmit_by(const PortWay *way, PyObject *self, PyObject *frame);

#endif
