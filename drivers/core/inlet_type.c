/* Python's Inlet (native.pyi): unpacks the frames of one TPDO. */
#include <assert.h>
#include <string.h>

#include "inlet.h"
#include "types.h"

PyTypeObject *inlet_type;

enum { FIELD_OCTETS_MAX = 4, KEPT_AT_FIRST = 64 };

static InletObject *inlet_of(PyObject *self) { return (InletObject *)self; }

static bool is_mapped(const InletObject *self, Told which) { return self->fields[which].octets > 0; }

static int64_t field(const InletObject *self, const unsigned char *octets, Told which)
{
    const OctetField *place = &self->fields[which];
    assert(place->octets > 0 && place->place + place->octets <= self->octets);
    uint64_t raw = 0, sign = (uint64_t)1 << (8 * place->octets - 1);
    for (int octet = 0; octet < place->octets; octet++)
        raw |= (uint64_t)octets[place->place + octet] << 8 * octet;
    return place->is_signed ? (int64_t)((raw ^ sign) - sign) : (int64_t)raw;
}

static bool keep(InletObject *self, const char *octets, Py_ssize_t length, int64_t at)
{
    if (self->kept_count == self->kept_room) {
        Py_ssize_t room = self->kept_room ? 2 * self->kept_room : KEPT_AT_FIRST;
        KeptFrame *kept = PyMem_Realloc(self->kept, (size_t)room * sizeof *kept);
        if (kept == NULL) {
            PyErr_NoMemory();
            return false;
        }
        self->kept = kept;
        self->kept_room = room;
    }
    assert(0 <= self->kept_count && self->kept_count < self->kept_room);
    KeptFrame *frame = &self->kept[self->kept_count++];
    *frame = (KeptFrame){.at = at, .length = length};
    memcpy(frame->data, octets, (size_t)length);
    return true;
}

static bool take_state(InletObject *self, const unsigned char *octets, int64_t at)
{
    ReceptionObject *reception = self->reception;
    if (is_mapped(self, MODE) && !follow_mode(reception->follow, field(self, octets, MODE), at))
        return false;
    if (!is_mapped(self, STATUS))
        return true;
    int64_t statusword = field(self, octets, STATUS);
    reception->told->statusword = reception->told->by_pdo = statusword;
    reception->told->at = at;
    return follow_status(reception->follow, statusword, at);
}

static bool take_values(InletObject *self, const unsigned char *octets, int64_t at)
{
    ReceptionObject *reception = self->reception;
    if (is_mapped(self, TORQUE))
        torque_told(&reception->state, field(self, octets, TORQUE), at);
    if (is_mapped(self, POSITION) && !anchor_position(reception, field(self, octets, POSITION), at))
        return false;
    bool speed = is_mapped(self, VELOCITY);
    int64_t stamp = is_mapped(self, STAMP) ? field(self, octets, STAMP) : NO_STAMP;
    if (speed && !speed_told(reception, field(self, octets, VELOCITY), stamp, at))
        return false;
    if (is_mapped(self, DEMAND) && !demand_told(reception, field(self, octets, DEMAND), at, speed))
        return false;
    if (is_mapped(self, WATCHED) && is_there(reception->watch))
        tell_watch(reception, &((CommandWatchObject *)reception->watch)->watch, field(self, octets, WATCHED));
    return true;
}

/* `data`: octets. */
bool take_pdo(InletObject *self, PyObject *data, int64_t at)
{
    char *octets;
    Py_ssize_t length;
    if (PyBytes_AsStringAndSize(data, &octets, &length) < 0)
        return false;
    if (self->keeps && length <= FRAME_OCTETS_MAX && !keep(self, octets, length, at))
        return false;
    if (length != self->octets) {
        self->reception->state.malformed++;
        return true;
    }
    const unsigned char *raw = (const unsigned char *)octets;
    if (self->on_change)
        return demand_changed(self->reception, field(self, raw, DEMAND), field(self, raw, STAMP), at);
    return take_state(self, raw, at) && take_values(self, raw, at);
}

/* A place, the octets there, and whether they are signed; or None. */
static bool read_field(PyObject *given, int octets, OctetField *field)
{
    int64_t place, count;
    if (!is_there(given))
        return true;
    if (!is_a(given, &PyTuple_Type, "a tuple") || !takes(PyTuple_Size(given), 3, "a field")
        || !integer(PyTuple_GetItem(given, 0), &place) || !integer(PyTuple_GetItem(given, 1), &count))
        return false;
    int is_signed = PyObject_IsTrue(PyTuple_GetItem(given, 2));
    if (is_signed < 0)
        return false;
    if (place < 0 || count < 1 || count > FIELD_OCTETS_MAX || place > octets - count) {
        PyErr_Format(PyExc_ValueError, "%lld octets at %lld: 1 to %d of %d expected", (long long)count,
                     (long long)place, FIELD_OCTETS_MAX, octets);
        return false;
    }
    *field = (OctetField){(int)place, (int)count, is_signed != 0};
    return true;
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    int64_t octets;
    if (!takes_between(arguments, names, 4, 4, "Inlet")
        || !is_a(PyTuple_GetItem(arguments, 0), reception_type, "a Reception")
        || !integer(PyTuple_GetItem(arguments, 1), &octets)
        || !is_a(PyTuple_GetItem(arguments, 2), &PyTuple_Type, "a tuple")
        || !takes(PyTuple_Size(PyTuple_GetItem(arguments, 2)), TOLD_COUNT, "the fields of an Inlet"))
        return NULL;
    int on_change = PyObject_IsTrue(PyTuple_GetItem(arguments, 3));
    if (on_change < 0)
        return NULL;
    if (octets < 0 || octets > FRAME_OCTETS_MAX)
        return PyErr_Format(PyExc_ValueError, "a PDO of %lld octets: at most %d expected", (long long)octets, FRAME_OCTETS_MAX);
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    InletObject *inlet = inlet_of(self);
    inlet->reception = (ReceptionObject *)another(PyTuple_GetItem(arguments, 0));
    inlet->octets = (int)octets;
    bool well = true;
    for (int which = 0; well && which < TOLD_COUNT; which++)
        well = read_field(PyTuple_GetItem(PyTuple_GetItem(arguments, 2), which), inlet->octets, &inlet->fields[which]);
    inlet->on_change = on_change && is_mapped(inlet, DEMAND) && is_mapped(inlet, STAMP);
    if (!well)
        forget(&self);
    return self;
}

static int visit_inlet(PyObject *self, visitproc visit, void *argument)
{
    int result = visit_one((PyObject *)self->type, visit, argument);
    return result ? result : visit_one((PyObject *)inlet_of(self)->reception, visit, argument);
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    InletObject *inlet = inlet_of(self);
    PyObject *reception = (PyObject *)inlet->reception;
    forget(&reception);
    PyMem_Free(inlet->kept);
    end_object(self);
}

static PyObject *call_inlet(PyObject *self, PyObject *arguments, PyObject *names)
{
    int64_t at;
    if (!takes_between(arguments, names, 2, 2, "Inlet")
        || !is_a(PyTuple_GetItem(arguments, 0), &PyBytes_Type, "octets")
        || !integer(PyTuple_GetItem(arguments, 1), &at))
        return NULL;
    return take_pdo(inlet_of(self), PyTuple_GetItem(arguments, 0), at) ? nothing() : NULL;
}

static PyObject *call_keep(PyObject *self, PyObject *none)
{
    (void)none;
    inlet_of(self)->keeps = true;
    inlet_of(self)->kept_count = 0;
    return nothing();
}

static PyObject *call_take_kept(PyObject *self, PyObject *none)
{
    (void)none;
    InletObject *inlet = inlet_of(self);
    Py_ssize_t octets = inlet->kept_count * (Py_ssize_t)sizeof *inlet->kept;
    inlet->kept_count = 0;
    return PyBytes_FromStringAndSize((const char *)inlet->kept, octets);
}

static PyMethodDef methods[] = {
    {"keep", call_keep, METH_NOARGS, NULL},
    {"take_kept", call_take_kept, METH_NOARGS, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_inlet},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_call, (void *)call_inlet},
    {Py_tp_methods, methods},
    {0},
};

PyType_Spec inlet_spec = {
    .name = "servobench.drivers.core.native.Inlet",
    .basicsize = sizeof(InletObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
