#include "port_way.h"

#include "arguments.h"
#include "types.h"

/* A getter; its closure is the way. */
PyObject *show_way(PyObject *self, void *way)
{
    (void)self;
    return PyCapsule_New(way, PORT_WAY, NULL);
}

PyObject *receive_by(const PortWay *way, PyObject *self, PyObject *until)
{
    int64_t until_ns;
    Arrived arrived;
    int came = integer(until, &until_ns) ? way->receive(self, until_ns, &arrived) : -1;
    return came < 0 ? NULL : came == 0 ? nothing() : received_tuple(&arrived);
}

PyObject *transmit_by(const PortWay *way, PyObject *self, PyObject *frame)
{
    bool well = is_a(frame, frame_type, "a WireFrame") && way->transmit(self, (FrameObject *)frame);
    return well ? nothing() : NULL;
}
