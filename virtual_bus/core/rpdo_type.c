/* Python's CyclicRpdo (native.pyi): one RPDO's reception (CiA 301, 7.5.2.35). */
#include <assert.h>
#include <stddef.h>

#include "attributes.h"
#include "device.h"
#include "types.h"

PyTypeObject *rpdo_type;

enum { HELD_COUNT = 6 };

static RpdoObject *rpdo_of(PyObject *self) { return (RpdoObject *)self; }

static void places_of(RpdoObject *self, PyObject **places[HELD_COUNT])
{
    places[0] = (PyObject **)&self->device;
    places[1] = (PyObject **)&self->codec;
    places[2] = &self->judge_length;
    places[3] = (PyObject **)&self->deadline;
    places[4] = &self->deadline_met;
    places[5] = &self->waiting;
}

/* ---- values into variables ---- */

/* Whether `value` is on that side of a variable's limit: 1, 0, or -1 for an error. */
static int is_beyond(PyObject *value, PyObject *variable, Attribute *limit, int side)
{
    PyObject *most = attribute(limit, variable);
    int beyond = most == NULL ? -1 : most == Py_None ? 0 : PyObject_RichCompareBool(value, most, side);
    forget(&most);
    return beyond;
}

/* Whether the variable may not take `value`, as servobench.virtual_bus.device.object_dictionary.Variable.refusal. */
static int is_refused(PyObject *value, PyObject *variable)
{
    static Attribute high = {.spelt = "high"}, low = {.spelt = "low"}, check = {.spelt = "check"};
    int beyond = is_beyond(value, variable, &high, Py_GT);
    if (beyond == 0)
        beyond = is_beyond(value, variable, &low, Py_LT);
    if (beyond != 0)
        return beyond;
    PyObject *asked = attribute(&check, variable);
    PyObject *refusal = NULL;
    if (asked != NULL && asked != Py_None)
        refusal = PyObject_Vectorcall(asked, &value, 1, NULL);
    else if (asked != NULL)
        refusal = nothing();
    int refused = refusal == NULL ? -1 : refusal != Py_None;
    forget(&refusal);
    forget(&asked);
    return refused;
}

static bool was_refused(PyObject *const *variables, const bool *refused, int count, const PyObject *variable)
{
    for (int place = 0; place < count; place++) {
        if (refused[place] && variables[place] == variable)
            return true;
    }
    return false;
}

static bool call_hook(PyObject *variable, PyObject *value)
{
    static Attribute on_write = {.spelt = "on_write"};
    PyObject *hook = attribute(&on_write, variable);
    bool well = hook != NULL && (hook == Py_None || went_well(PyObject_Vectorcall(hook, &value, 1, NULL)));
    forget(&hook);
    return well;
}

/* Store every value, then let the application act on them. */
static bool store(PyObject *const *variables, PyObject *const *values, int count)
{
    static Attribute held = {.spelt = "value"};
    bool refused[PDO_FIELDS_MAX];
    for (int place = 0; place < count; place++) {
        int refuses = is_refused(values[place], variables[place]);
        if (refuses < 0 || (refuses == 0 && !set_attribute(&held, variables[place], values[place])))
            return false;
        refused[place] = refuses != 0;
    }
    for (int place = 0; place < count; place++) {
        if (!was_refused(variables, refused, count, variables[place]) && !call_hook(variables[place], values[place]))
            return false;
    }
    return true;
}

static bool apply(RpdoObject *self, PyObject *data)
{
    PyObject *variables[PDO_FIELDS_MAX], *values[PDO_FIELDS_MAX];
    const CodecObject *codec = self->codec;
    char *octets;
    Py_ssize_t length;
    int filled = 0;
    if (PyBytes_AsStringAndSize(data, &octets, &length) < 0)
        return false;
    if (length < image_octets(codec->bits)) {
        PyErr_Format(PyExc_ValueError, "%zd octets: at least %d expected", length, image_octets(codec->bits));
        return false;
    }
    int count = unpack_values(codec, (const unsigned char *)octets, values);
    for (int place = 0; place < codec->count && count >= 0; place++) {
        if (codec->fields[place].kind != GAP)
            variables[filled++] = another(codec->variables[place]); /* a hook may map others */
    }
    assert(count < 0 || filled == count);
    bool well = count >= 0 && store(variables, values, count);
    for (int place = 0; place < count; place++) {
        Py_DecRef(values[place]);
        Py_DecRef(variables[place]);
    }
    return well;
}

/* A SYNC: what came since the last one takes effect. */
bool actuate_rpdo(RpdoObject *self)
{
    PyObject *data = self->waiting;
    self->waiting = NULL;
    bool well = apply(self, data);
    Py_DecRef(data);
    return well;
}

static bool call_with_length(PyObject *judge, Py_ssize_t length)
{
    PyObject *argument = PyLong_FromLongLong(length);
    bool well = argument != NULL && went_well(PyObject_Vectorcall(judge, &argument, 1, NULL));
    forget(&argument);
    return well;
}

static bool restart_deadline(RpdoObject *self, int64_t now)
{
    start_timer(self->deadline, now + self->deadline_ns);
    if (!self->missed)
        return true;
    self->missed = false;
    return went_well(PyObject_Vectorcall(self->deadline_met, NULL, 0, NULL));
}

bool take_rpdo(RpdoObject *self, const FrameObject *frame, int64_t now)
{
    if (!self->device->operational)
        return true;
    Py_ssize_t length = PyObject_Size(frame->data);
    if (length != self->length || self->wrong_length) {
        if (!call_with_length(self->judge_length, length))
            return false;
        if (length < self->length)
            return true;
    }
    if (self->deadline_ns && !restart_deadline(self, now))
        return false;
    if (!self->synchronous)
        return apply(self, frame->data);
    if (self->window_open) {
        PyObject *before = self->waiting;
        self->waiting = another(frame->data);
        forget(&before);
    }
    return true;
}

/* ---- what Python sees ---- */

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, 5, 5, "CyclicRpdo")
        || !is_a(PyTuple_GetItem(arguments, 0), device_type, "a CyclicDevice")
        || !is_a(PyTuple_GetItem(arguments, 2), timer_type, "a Timer")
        || !is_a(PyTuple_GetItem(arguments, 4), codec_type, "a PdoCodec"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    rpdo_of(self)->device = (DeviceObject *)another(PyTuple_GetItem(arguments, 0));
    rpdo_of(self)->judge_length = another(PyTuple_GetItem(arguments, 1));
    rpdo_of(self)->deadline = (TimerObject *)another(PyTuple_GetItem(arguments, 2));
    rpdo_of(self)->deadline_met = another(PyTuple_GetItem(arguments, 3));
    rpdo_of(self)->codec = (CodecObject *)another(PyTuple_GetItem(arguments, 4));
    rpdo_of(self)->window_open = true;
    return self;
}

static int visit_rpdo(PyObject *self, visitproc visit, void *argument)
{
    PyObject **places[HELD_COUNT];
    places_of(rpdo_of(self), places);
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_each(places, HELD_COUNT, visit, argument);
}

/* Device, timer and codec stay: they are counted on. */
static int clear_rpdo(PyObject *self)
{
    PyObject *before[] = {rpdo_of(self)->judge_length, rpdo_of(self)->deadline_met};
    rpdo_of(self)->judge_length = nothing();
    rpdo_of(self)->deadline_met = nothing();
    forget(&before[0]);
    forget(&before[1]);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject **places[HELD_COUNT];
    PyObject_GC_UnTrack(self);
    places_of(rpdo_of(self), places);
    forget_each(places, HELD_COUNT);
    end_object(self);
}

static PyObject *call_map(PyObject *self, PyObject *codec)
{
    if (!is_a(codec, codec_type, "a PdoCodec"))
        return NULL;
    PyObject *before = (PyObject *)rpdo_of(self)->codec;
    rpdo_of(self)->codec = (CodecObject *)another(codec);
    rpdo_of(self)->length = image_octets(rpdo_of(self)->codec->bits);
    forget(&before);
    return nothing();
}

static PyObject *call_forget_waiting(PyObject *self, PyObject *none)
{
    (void)none;
    forget(&rpdo_of(self)->waiting);
    return nothing();
}

static PyObject *call_take(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t now;
    if (!takes(count, 2, "take") || !is_a(arguments[0], frame_type, "a WireFrame") || !integer(arguments[1], &now))
        return NULL;
    return take_rpdo(rpdo_of(self), (FrameObject *)arguments[0], now) ? nothing() : NULL;
}

static PyMethodDef methods[] = {
    {"take", (PyCFunction)(void (*)(void))call_take, METH_FASTCALL, NULL},
    {"map", call_map, METH_O, NULL},
    {"forget_waiting", call_forget_waiting, METH_NOARGS, NULL},
    {0},
};

#define PLACE(path) offsetof(RpdoObject, path)

static PyMemberDef members[] = {
    {"length", T_LONGLONG, PLACE(length), READONLY, NULL},
    {"deadline_ns", T_LONGLONG, PLACE(deadline_ns), 0, NULL},
    {"missed", T_BOOL, PLACE(missed), 0, NULL},
    {"wrong_length", T_INT, PLACE(wrong_length), 0, NULL},
    {"synchronous", T_BOOL, PLACE(synchronous), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_rpdo},
    {Py_tp_clear, (void *)clear_rpdo},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec rpdo_spec = {
    .name = "servobench.virtual_bus.core.native.CyclicRpdo",
    .basicsize = sizeof(RpdoObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
