/* Python's CyclicTpdo (native.pyi): one TPDO's turn at a SYNC or a change (CiA 301, 7.5.2.37). */
#include <stddef.h>

#include "device.h"
#include "types.h"

PyTypeObject *tpdo_type;

enum { HELD_COUNT = 5 };

static TpdoObject *tpdo_of(PyObject *self) { return (TpdoObject *)self; }

static void places_of(TpdoObject *self, PyObject **places[HELD_COUNT])
{
    places[0] = (PyObject **)&self->device;
    places[1] = &self->on_event;
    places[2] = &self->latched;
    places[3] = (PyObject **)&self->sample;
    places[4] = (PyObject **)&self->watch;
}

/* ---- turns ---- */

static bool latch(TpdoObject *self)
{
    PyObject *sample = another((PyObject *)self->sample); /* a provider may have the PDO mapped anew */
    PyObject *octets = pack_octets((CodecObject *)sample);
    Py_DecRef(sample);
    if (octets == NULL)
        return false;
    PyObject *before = self->latched;
    self->latched = octets;
    forget(&before);
    return true;
}

static bool send_latched(TpdoObject *self)
{
    PyObject *frame = (PyObject *)make_frame(frame_type, self->can_id, self->latched);
    bool well = frame != NULL && queue_frame(self->device, frame);
    forget(&frame);
    return well;
}

static int changed(TpdoObject *self)
{
    PyObject *watch = another((PyObject *)self->watch);
    int differs = look_at_image((CodecObject *)watch);
    Py_DecRef(watch);
    return differs;
}

/* Sample and send; what it looks at is seen by that. */
static bool transmit(TpdoObject *self) { return changed(self) >= 0 && latch(self) && send_latched(self); }

static bool take_turn(TpdoObject *self, int64_t counter)
{
    if (self->start_at) {
        /* The SYNC with the start value is the first that counts, and the PDO goes out with it. */
        if (counter != self->start_at)
            return true;
        self->start_at = 0;
        self->left = 1;
    }
    if (--self->left)
        return true;
    self->left = self->type;
    return latch(self) && send_latched(self);
}

/* A SYNC in OPERATIONAL; `counter` 0 without one. */
bool tpdo_at_sync(TpdoObject *self, int64_t counter)
{
    if (self->type > SYNCHRONOUS_ACYCLIC && self->type <= SYNCHRONOUS_CYCLIC_MAX)
        return take_turn(self, counter);
    if (self->type == REMOTE_SYNCHRONOUS)
        return latch(self);
    if (!self->event)
        return true;
    self->event = false;
    return transmit(self);
}

/* An event, if a mapped object has changed since the last look. */
bool look_at_tpdo(TpdoObject *self)
{
    int differs = changed(self);
    if (differs <= 0)
        return differs == 0;
    if (self->type != SYNCHRONOUS_ACYCLIC)
        return call_with_instant(self->on_event, self->device->now);
    self->event = true;
    return true;
}

/* ---- what Python sees ---- */

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, 4, 4, "CyclicTpdo")
        || !is_a(PyTuple_GetItem(arguments, 0), device_type, "a CyclicDevice")
        || !is_a(PyTuple_GetItem(arguments, 2), codec_type, "a PdoCodec")
        || !is_a(PyTuple_GetItem(arguments, 3), codec_type, "a PdoCodec"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    TpdoObject *tpdo = tpdo_of(self);
    tpdo->device = (DeviceObject *)another(PyTuple_GetItem(arguments, 0));
    tpdo->on_event = another(PyTuple_GetItem(arguments, 1));
    tpdo->sample = (CodecObject *)another(PyTuple_GetItem(arguments, 2));
    tpdo->watch = (CodecObject *)another(PyTuple_GetItem(arguments, 3));
    tpdo->latched = PyBytes_FromStringAndSize(NULL, 0);
    if (tpdo->latched == NULL)
        forget(&self);
    return self;
}

static int visit_tpdo(PyObject *self, visitproc visit, void *argument)
{
    PyObject **places[HELD_COUNT];
    places_of(tpdo_of(self), places);
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_each(places, HELD_COUNT, visit, argument);
}

/* Device, codecs and octets stay: they are counted on. */
static int clear_tpdo(PyObject *self)
{
    PyObject *before = tpdo_of(self)->on_event;
    tpdo_of(self)->on_event = nothing();
    forget(&before);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject **places[HELD_COUNT];
    PyObject_GC_UnTrack(self);
    places_of(tpdo_of(self), places);
    forget_each(places, HELD_COUNT);
    end_object(self);
}

static PyObject *call_map(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    if (!takes(count, 2, "map") || !is_a(arguments[0], codec_type, "a PdoCodec")
        || !is_a(arguments[1], codec_type, "a PdoCodec"))
        return NULL;
    PyObject *before[] = {(PyObject *)tpdo_of(self)->sample, (PyObject *)tpdo_of(self)->watch};
    tpdo_of(self)->sample = (CodecObject *)another(arguments[0]);
    tpdo_of(self)->watch = (CodecObject *)another(arguments[1]);
    forget(&before[0]);
    forget(&before[1]);
    return nothing();
}

static PyObject *call_latch(PyObject *self, PyObject *none)
{
    (void)none;
    return latch(tpdo_of(self)) ? nothing() : NULL;
}

static PyObject *call_look(PyObject *self, PyObject *none)
{
    (void)none;
    return changed(tpdo_of(self)) < 0 ? NULL : nothing();
}

static PyObject *call_transmit(PyObject *self, PyObject *none)
{
    (void)none;
    return transmit(tpdo_of(self)) ? nothing() : NULL;
}

static PyObject *call_send_latched(PyObject *self, PyObject *none)
{
    (void)none;
    return send_latched(tpdo_of(self)) ? nothing() : NULL;
}

static PyMethodDef methods[] = {
    {"map", (PyCFunction)(void (*)(void))call_map, METH_FASTCALL, NULL},
    {"latch", call_latch, METH_NOARGS, NULL},
    {"look", call_look, METH_NOARGS, NULL},
    {"transmit", call_transmit, METH_NOARGS, NULL},
    {"send_latched", call_send_latched, METH_NOARGS, NULL},
    {0},
};

#define PLACE(path) offsetof(TpdoObject, path)

static PyMemberDef members[] = {
    {"can_id", T_LONGLONG, PLACE(can_id), 0, NULL},
    {"type", T_INT, PLACE(type), 0, NULL},
    {"left", T_LONGLONG, PLACE(left), 0, NULL},
    {"start_at", T_LONGLONG, PLACE(start_at), 0, NULL},
    {"follows_sync", T_BOOL, PLACE(follows_sync), 0, NULL},
    {"event", T_BOOL, PLACE(event), 0, NULL},
    {"runs", T_BOOL, PLACE(runs), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_tpdo},
    {Py_tp_clear, (void *)clear_tpdo},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec tpdo_spec = {
    .name = "servobench.virtual_bus.core.native.CyclicTpdo",
    .basicsize = sizeof(TpdoObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
