/* Python's Segment (native.pyi). */
#include <stddef.h>

#include "objects.h"
#include "segment.h"
#include "types.h"

PyTypeObject *segment_type;

static SegmentObject *segment_of(PyObject *self) { return (SegmentObject *)self; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)names;
    int64_t bitrate_bit_s;
    if (!takes(PyTuple_Size(arguments), 2, "Segment")
        || !is_a(PyTuple_GetItem(arguments, 0), timeline_type, "a Timeline")
        || !integer(PyTuple_GetItem(arguments, 1), &bitrate_bit_s))
        return NULL;
    if (bitrate_bit_s <= 0) {
        PyErr_Format(PyExc_ValueError, "bitrate %lld bit/s: it must be positive", (long long)bitrate_bit_s);
        return NULL;
    }
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    SegmentObject *segment = segment_of(self);
    segment->timeline = (TimelineObject *)another(PyTuple_GetItem(arguments, 0));
    segment->ports = PyTuple_New(0);
    segment->monitors = PyTuple_New(0);
    set_bitrate(segment, bitrate_bit_s);
    segment->load = (LoadObject *)PyType_GenericAlloc(load_type, 0);
    if (segment->ports != NULL && segment->monitors != NULL && segment->load != NULL) {
        start_load(&segment->load->load);
        return self;
    }
    Py_DecRef(self);
    return NULL;
}

static int visit_segment(PyObject *self, visitproc visit, void *argument)
{
    SegmentObject *segment = segment_of(self);
    PyObject *held[] = {(PyObject *)self->type,  (PyObject *)segment->timeline, segment->ports,
                        segment->monitors, segment->handling,             (PyObject *)segment->sender};
    for (size_t place = 0; place < sizeof held / sizeof *held; place++) {
        int result = visit_one(held[place], visit, argument);
        if (result)
            return result;
    }
    for (int place = 0; place < segment->contender_count; place++) {
        int result = visit((PyObject *)segment->contenders[place], argument);
        if (result)
            return result;
    }
    return 0;
}

static void forget_contenders(SegmentObject *self)
{
    while (self->contender_count > 0)
        Py_DecRef((PyObject *)self->contenders[--self->contender_count]);
}

/* What is left can still be used: a segment without ports. Its timeline it is never without. */
static int clear_segment(PyObject *self)
{
    SegmentObject *segment = segment_of(self);
    PyObject *sender = (PyObject *)segment->sender;
    segment->sender = NULL;
    if (sender != NULL)
        Py_DecRef(sender);
    forget_contenders(segment);
    forget(&segment->handling);
    PyObject **tuples[] = {&segment->ports, &segment->monitors};
    for (int which = 0; which < 2; which++) {
        PyObject *before = *tuples[which];
        *tuples[which] = PyTuple_New(0); /* the one empty tuple, which is there already */
        if (before != NULL)
            Py_DecRef(before);
    }
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    SegmentObject *segment = segment_of(self);
    clear_segment(self);
    forget(&segment->ports);
    forget(&segment->monitors);
    PyMem_Free(segment->contenders);
    PyObject *held[] = {(PyObject *)segment->timeline, (PyObject *)segment->load};
    forget(&held[0]);
    forget(&held[1]);
    end_object(self);
}

/* The tuple without `gone`, and with `come` at its end where it is not NULL. */
static PyObject *changed(PyObject *tuple, PyObject *gone, PyObject *come)
{
    Py_ssize_t size = PyTuple_Size(tuple), kept = 0, place = 0;
    for (Py_ssize_t k = 0; k < size; k++)
        kept += PyTuple_GetItem(tuple, k) != gone;
    PyObject *made = PyTuple_New(kept + (come != NULL));
    if (made == NULL)
        return NULL;
    for (Py_ssize_t k = 0; k < size; k++) {
        if (PyTuple_GetItem(tuple, k) != gone)
            PyTuple_SetItem(made, place++, another(PyTuple_GetItem(tuple, k)));
    }
    if (come != NULL)
        PyTuple_SetItem(made, place, another(come));
    return made;
}

static PyObject *change(PyObject **place, PyObject *gone, PyObject *come)
{
    PyObject *made = changed(*place, gone, come), *before = *place;
    if (made == NULL)
        return NULL;
    *place = made;
    Py_DecRef(before);
    return nothing();
}

static PyObject *call_add_port(PyObject *self, PyObject *port)
{
    return is_a(port, port_type, "a Port") ? change(&segment_of(self)->ports, NULL, port) : NULL;
}

static PyObject *call_remove_port(PyObject *self, PyObject *port)
{
    return change(&segment_of(self)->ports, port, NULL);
}

static PyObject *call_add_monitor(PyObject *self, PyObject *on_frame)
{
    return change(&segment_of(self)->monitors, NULL, on_frame);
}

static PyObject *call_hand_over(PyObject *self, PyObject *handling)
{
    SegmentObject *segment = segment_of(self);
    PyObject *waiting = PyTuple_New(segment->contender_count);
    PyObject *made = PyTuple_New(2);
    if (waiting == NULL || made == NULL) {
        forget(&waiting);
        forget(&made);
        return NULL;
    }
    for (int place = segment->contender_count - 1; place >= 0; place--)
        PyTuple_SetItem(waiting, place, (PyObject *)segment->contenders[place]);
    segment->contender_count = 0;
    PyTuple_SetItem(made, 0, segment->sender == NULL ? nothing() : (PyObject *)segment->sender);
    PyTuple_SetItem(made, 1, waiting);
    segment->sender = NULL;
    PyObject *before = segment->handling;
    segment->handling = another(handling);
    forget(&before);
    return made;
}

static PyMethodDef methods[] = {
    {"add_port", call_add_port, METH_O, NULL},
    {"remove_port", call_remove_port, METH_O, NULL},
    {"add_monitor", call_add_monitor, METH_O, NULL},
    {"hand_over", call_hand_over, METH_O, NULL},
    {0},
};

#define PLACE(path) offsetof(SegmentObject, path)

static PyMemberDef members[] = {
    {"timeline", T_OBJECT, PLACE(timeline), READONLY, NULL},
    {"load", T_OBJECT, PLACE(load), READONLY, NULL},
    {"ports", T_OBJECT, PLACE(ports), READONLY, NULL},
    {"monitors", T_OBJECT, PLACE(monitors), READONLY, NULL},
    {"handling", T_OBJECT, PLACE(handling), READONLY, NULL},
    {"bitrate_bit_s", T_LONGLONG, PLACE(bitrate_bit_s), READONLY, NULL},
    {"intermission_ns", T_LONGLONG, PLACE(intermission_ns), READONLY, NULL},
    {"start_at", T_LONGLONG, PLACE(start_at), READONLY, NULL},
    {"end_at", T_LONGLONG, PLACE(end_at), READONLY, NULL},
    {"free_at", T_LONGLONG, PLACE(free_at), 0, NULL},
    {"frames", T_LONGLONG, PLACE(frames), 0, NULL},
    {"delivering", T_BOOL, PLACE(delivering), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_segment},
    {Py_tp_clear, (void *)clear_segment},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec segment_spec = {
    .name = "servobench.virtual_bus.core.native.Segment",
    .basicsize = sizeof(SegmentObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
