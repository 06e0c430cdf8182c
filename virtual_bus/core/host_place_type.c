/* Python's HostPlace (native.pyi). */
#include <stddef.h>

#include "host_place.h"
#include "objects.h"
#include "port_way.h"
#include "types.h"

PyTypeObject *place_type;

static PlaceObject *place_of(PyObject *self) { return (PlaceObject *)self; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)names;
    if (!takes(PyTuple_Size(arguments), 1, "HostPlace")
        || !is_a(PyTuple_GetItem(arguments, 0), timeline_type, "a Timeline"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    PlaceObject *place = place_of(self);
    place->timeline = (TimelineObject *)another(PyTuple_GetItem(arguments, 0));
    place->held_in = (HeldObject *)PyType_GenericAlloc(held_type, 0);
    place->held_out = (HeldObject *)PyType_GenericAlloc(held_type, 0);
    if (place->held_in != NULL && place->held_out != NULL)
        return self;
    Py_DecRef(self);
    return NULL;
}

static int visit_place(PyObject *self, visitproc visit, void *argument)
{
    PlaceObject *place = place_of(self);
    PyObject *held[] = {(PyObject *)self->type,   (PyObject *)place->timeline, (PyObject *)place->port, place->judge,
                        place->accepts, (PyObject *)place->held_in,  (PyObject *)place->held_out};
    for (size_t which = 0; which < sizeof held / sizeof *held; which++) {
        int result = visit_one(held[which], visit, argument);
        if (result)
            return result;
    }
    for (int number = 0; number < place->count; number++) {
        int result = visit(place->inbox[(place->first + number) % place->room].frame, argument);
        if (result)
            return result;
    }
    return 0;
}

/* Its port has a clear of its own, and it is never without it. */
static int clear_place(PyObject *self)
{
    place_of(self)->fates = NULL;
    forget(&place_of(self)->judge);
    forget(&place_of(self)->accepts);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    PlaceObject *place = place_of(self);
    clear_place(self);
    while (place->count > 0)
        Py_DecRef(take_arrival(place).frame);
    PyMem_Free(place->inbox);
    PyObject *held[] = {(PyObject *)place->port, (PyObject *)place->held_in, (PyObject *)place->held_out,
                        (PyObject *)place->timeline};
    for (size_t which = 0; which < sizeof held / sizeof *held; which++)
        forget(&held[which]);
    end_object(self);
}

static PyObject *call_take_port(PyObject *self, PyObject *port)
{
    PlaceObject *place = place_of(self);
    if (!is_a(port, port_type, "a Port"))
        return NULL;
    PyObject *before = (PyObject *)place->port;
    place->port = (PortObject *)another(port);
    forget(&before);
    return nothing();
}

static PyObject *call_put_before(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t way_out;
    if (!takes(count, 2, "put_before") || !integer(arguments[1], &way_out))
        return NULL;
    PlaceObject *place = place_of(self);
    PyObject *before = place->judge;
    PyTypeObject *type = arguments[0]->type;
    bool is_native = type == fates_type || PyType_IsSubtype(type, fates_type);
    int own_hold = is_native ? is_overridden(type, fates_type, "hold") : 1;
    if (own_hold < 0)
        return NULL;
    place->judge = another(arguments[0]);
    place->fates = own_hold ? NULL : (FatesObject *)place->judge;
    place->way_out = way_out != 0;
    place->way_in = way_out == 0;
    forget(&before);
    return nothing();
}

/* By the method of a Python class on top of the timeline, where there is one: 1, 0, or -1 for an error. */
static int pass_until_filled(PyObject *self, int64_t until)
{
    static PyObject *name;
    PlaceObject *place = place_of(self);
    PyObject *timeline = (PyObject *)place->timeline;
    if (timeline->type == timeline_type)
        return run_until_filled(place->timeline, until, self);
    if (name == NULL && (name = PyUnicode_InternFromString("run_until_filled")) == NULL)
        return -1;
    PyObject *arguments[] = {timeline, PyLong_FromLongLong(until), self};
    PyObject *filled = arguments[1] == NULL ? NULL : PyObject_VectorcallMethod(name, arguments, 3, NULL);
    int result = filled == NULL ? -1 : place->count > 0;
    forget(&filled);
    forget(&arguments[1]);
    return result;
}

/* Time passes no further than to the next frame, or to `until`. */
static int receive(PyObject *self, int64_t until, Arrived *arrived)
{
    PlaceObject *place = place_of(self);
    if (place->count == 0) {
        int filled = pass_until_filled(self, until);
        if (filled <= 0)
            return filled;
    }
    Arrival arrival = take_arrival(place);
    *arrived = (Arrived){(FrameObject *)arrival.frame, arrival.at, arrival.own};
    return 1;
}

static bool transmit(PyObject *self, FrameObject *object)
{
    WireFrame frame;
    PlaceObject *place = place_of(self);
    if (place->port == NULL)
        PyErr_Format(PyExc_ValueError, "transmit: no port was taken yet");
    return place->port != NULL && read_frame((PyObject *)object, &frame) && transmit_frame(place, &frame);
}

static const PortWay way = {receive, transmit};

static PyObject *call_receive(PyObject *self, PyObject *until) { return receive_by(&way, self, until); }

static PyObject *call_transmit(PyObject *self, PyObject *frame) { return transmit_by(&way, self, frame); }

static PyObject *call_on_frame(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    WireFrame frame;
    int64_t now;
    if (!takes(count, 2, "on_frame") || !integer(arguments[1], &now) || !read_frame(arguments[0], &frame))
        return NULL;
    return hear_frame(place_of(self), &frame, now) ? nothing() : NULL;
}

static PyObject *call_on_sent(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t now;
    if (!takes(count, 2, "on_sent") || !integer(arguments[1], &now))
        return NULL;
    return keep_frame(place_of(self), arguments[0], now, true) ? nothing() : NULL;
}

/* The place whose bound on_sent this is, or NULL. */
PlaceObject *place_told(PyObject *on_sent)
{
    bool is_ours = on_sent->type == &PyCFunction_Type
                   && PyCFunction_GetFunction(on_sent) == (PyCFunction)(void (*)(void))call_on_sent;
    return is_ours ? place_of(PyCFunction_GetSelf(on_sent)) : NULL;
}

static Py_ssize_t length(PyObject *self) { return place_of(self)->count; }

static PyMethodDef methods[] = {
    {"take_port", call_take_port, METH_O, NULL},
    {"put_before", (PyCFunction)(void (*)(void))call_put_before, METH_FASTCALL, NULL},
    {"receive", call_receive, METH_O, NULL},
    {"transmit", call_transmit, METH_O, NULL},
    {"on_frame", (PyCFunction)(void (*)(void))call_on_frame, METH_FASTCALL, NULL},
    {"on_sent", (PyCFunction)(void (*)(void))call_on_sent, METH_FASTCALL, NULL},
    {0},
};

static PyGetSetDef attributes[] = {
    {"way", show_way, NULL, NULL, (void *)&way},
    {0},
};

#define PLACE(path) offsetof(PlaceObject, path)

static PyMemberDef members[] = {
    {"held_in", T_OBJECT, PLACE(held_in), READONLY, NULL},
    {"held_out", T_OBJECT, PLACE(held_out), READONLY, NULL},
    {"accepts", T_OBJECT, PLACE(accepts), 0, NULL},
    {"closed", T_BOOL, PLACE(closed), 0, NULL},
    {"overruns", T_LONGLONG, PLACE(overruns), READONLY, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_place},
    {Py_tp_clear, (void *)clear_place},
    {Py_tp_dealloc, (void *)discard},
    {Py_sq_length, (void *)length},
    {Py_tp_methods, methods},
    {Py_tp_getset, attributes},
    {Py_tp_members, members},
    {0},
};

PyType_Spec place_spec = {
    .name = "servobench.virtual_bus.core.native.HostPlace",
    .basicsize = sizeof(PlaceObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
