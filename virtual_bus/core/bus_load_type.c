/* Python's BusLoad (native.pyi). */
#include <stddef.h>

#include "bus_load.h"
#include "frames.h"
#include "segment.h"
#include "wire_bits.h"
#include "types.h"

PyTypeObject *load_type;

static BusLoad *load_of(PyObject *self) { return &((LoadObject *)self)->load; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    int64_t bitrate_bit_s = 0;
    if (!takes_between(arguments, names, 0, 1, "BusLoad")
        || (PyTuple_Size(arguments) == 1 && !integer(PyTuple_GetItem(arguments, 0), &bitrate_bit_s)))
        return NULL;
    if (bitrate_bit_s < 0)
        return PyErr_Format(PyExc_ValueError, "bitrate %lld bit/s: it must be positive", (long long)bitrate_bit_s);
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self != NULL) {
        start_load(load_of(self));
        ((LoadObject *)self)->bitrate_bit_s = bitrate_bit_s;
    }
    return self;
}

static void discard(PyObject *self) { end_object(self); }

static PyObject *call_add(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t duration_ns, end;
    if (!takes(count, 2, "add") || !integer(arguments[0], &duration_ns) || !integer(arguments[1], &end))
        return NULL;
    add_load(load_of(self), duration_ns, end);
    return nothing();
}

/* A frame that a link is told late counts where the last one ended. */
static bool take(PyObject *self, const FrameObject *frame, bool sent, int64_t at)
{
    LoadObject *load = (LoadObject *)self;
    WireFrame seen;
    (void)sent;
    if (load->bitrate_bit_s == 0) {
        PyErr_Format(PyExc_ValueError, "a load without a bit rate counts no frames");
        return false;
    }
    if (!read_frame((PyObject *)frame, &seen))
        return false;
    int64_t bits = wire_bits(seen.field, seen.data, seen.length) + INTERMISSION_BITS;
    load->last_end = at > load->last_end ? at : load->last_end;
    add_load(&load->load, bits_duration(bits, load->bitrate_bit_s), load->last_end);
    return true;
}

static const SinkWay way = {take};

static PyObject *get_way(PyObject *self, void *none)
{
    (void)self, (void)none;
    return PyCapsule_New((void *)&way, SINK_WAY, NULL);
}

static PyObject *call_show(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t at;
    if (!takes(count, 3, "show") || !is_a(arguments[0], frame_type, "a WireFrame") || !integer(arguments[2], &at))
        return NULL;
    int sent = PyObject_IsTrue(arguments[1]);
    return sent >= 0 && take(self, (const FrameObject *)arguments[0], sent != 0, at) ? nothing() : NULL;
}

static PyObject *call_busy_until(PyObject *self, PyObject *instant)
{
    int64_t when;
    return integer(instant, &when) ? PyLong_FromLongLong(busy_until(load_of(self), when)) : NULL;
}

static PyObject *call_percent(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t since, until;
    if (!takes(count, 2, "percent") || !integer(arguments[0], &since) || !integer(arguments[1], &until))
        return NULL;
    return PyFloat_FromDouble(load_percent(load_of(self), since, until));
}

static PyMethodDef methods[] = {
    {"add", (PyCFunction)(void (*)(void))call_add, METH_FASTCALL, NULL},
    {"busy_until", call_busy_until, METH_O, NULL},
    {"show", (PyCFunction)(void (*)(void))call_show, METH_FASTCALL, NULL},
    {"percent", (PyCFunction)(void (*)(void))call_percent, METH_FASTCALL, NULL},
    {0},
};

static PyGetSetDef attributes[] = {
    {"way", get_way, NULL, NULL, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"busy_ns", T_LONGLONG, offsetof(LoadObject, load.busy_ns), READONLY, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {Py_tp_getset, attributes},
    {0},
};

PyType_Spec load_spec = {
    .name = "servobench.virtual_bus.core.native.BusLoad",
    .basicsize = sizeof(LoadObject),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = slots,
};
