/* Python's DeviceClock (native.pyi): a device's own clock, and how 1013h tells of it.

       clock     local = offset + elapsed * (1 + drift), elapsed counted from power-on
       latched   the clock at the instant of sampling, of the SYNC's arrival, or of the next inner tick
       told      floor(latched / resolution) * resolution, in units, modulo 2^bits

   Devices differ in all of it. CiA 301 (7.5.2.16) asks for microseconds and for nothing else. Integers only. */
#include <stddef.h>

#include "device.h"
#include "types.h"

PyTypeObject *device_clock_type;

enum { BILLION = 1000000000 };

static DeviceClockObject *clock_of(PyObject *self) { return (DeviceClockObject *)self; }

static int64_t floored(int64_t value, int64_t by) { return value / by - (value % by != 0 && (value < 0) != (by < 0)); }

/* value * parts // 10^9, whose product may have more than 64 bits. */
static int64_t parts_of(int64_t value, int64_t parts)
{
    int64_t whole_billions = floored(value, BILLION);
    return whole_billions * parts + floored((value - whole_billions * BILLION) * parts, BILLION);
}

/* The clock's time, not wrapped. */
static int64_t local_ns(const DeviceClockObject *self, int64_t now)
{
    int64_t elapsed = now - self->started_at;
    return self->offset_ns + elapsed + parts_of(elapsed, self->drift_ppb);
}

static bool latched_at(const DeviceClockObject *self, int64_t now, int64_t *at)
{
    *at = self->at_arrival ? self->sync_at : now;
    if (is_there(self->tick_after)) {
        PyObject *argument = PyLong_FromLongLong(now);
        PyObject *tick = argument == NULL ? NULL : PyObject_Vectorcall(self->tick_after, &argument, 1, NULL);
        bool well = tick != NULL && integer(tick, at);
        forget(&tick);
        forget(&argument);
        if (!well)
            return false;
    }
    *at += self->late_ns;
    return true;
}

/* 1013h as it is told at the device's instant. */
bool tell_stamp(DeviceClockObject *self, int64_t *stamp)
{
    int64_t at;
    *stamp = self->written;
    if (!self->runs)
        return true;
    if (!latched_at(self, self->device->now, &at))
        return false;
    int64_t advanced_ns = floored(local_ns(self, at), self->resolution_ns) * self->resolution_ns;
    int64_t counts = floored(advanced_ns, self->unit_ns);
    *stamp = counts - floored(counts, self->wrap) * self->wrap;
    return true;
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    int64_t numbers[6];
    if (!takes_between(arguments, names, 9, 9, "DeviceClock")
        || !is_a(PyTuple_GetItem(arguments, 0), device_type, "a CyclicDevice"))
        return NULL;
    for (int place = 0; place < 6; place++) {
        if (!integer(PyTuple_GetItem(arguments, place + 1), &numbers[place]))
            return NULL;
    }
    if (numbers[2] < 1 || numbers[3] < 1 || numbers[4] < 1 || numbers[4] > 62)
        return PyErr_Format(PyExc_ValueError, "unit %lld ns, resolution %lld ns, %lld bits: 1.., 1.., 1..62 expected",
                            (long long)numbers[2], (long long)numbers[3], (long long)numbers[4]);
    int runs = PyObject_IsTrue(PyTuple_GetItem(arguments, 7));
    PyObject *self = runs < 0 ? NULL : PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    DeviceClockObject *clock = clock_of(self);
    clock->device = (DeviceObject *)another(PyTuple_GetItem(arguments, 0));
    clock->first_ns = clock->offset_ns = numbers[0];
    clock->drift_ppb = numbers[1];
    clock->unit_ns = numbers[2];
    clock->resolution_ns = numbers[3];
    clock->wrap = (int64_t)1 << numbers[4];
    clock->late_ns = numbers[5];
    clock->runs = runs != 0;
    clock->tick_after = another(PyTuple_GetItem(arguments, 8));
    return self;
}

static int visit_clock(PyObject *self, visitproc visit, void *argument)
{
    PyObject **places[] = {(PyObject **)&clock_of(self)->device, &clock_of(self)->tick_after};
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_each(places, 2, visit, argument);
}

/* The device stays: it is counted on. */
static int clear_clock(PyObject *self)
{
    PyObject *before = clock_of(self)->tick_after;
    clock_of(self)->tick_after = nothing();
    forget(&before);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject **places[] = {(PyObject **)&clock_of(self)->device, &clock_of(self)->tick_after};
    PyObject_GC_UnTrack(self);
    forget_each(places, 2);
    end_object(self);
}

static PyObject *call_start(PyObject *self, PyObject *now)
{
    int64_t now_ns;
    if (!integer(now, &now_ns))
        return NULL;
    clock_of(self)->offset_ns = clock_of(self)->first_ns;
    clock_of(self)->started_at = clock_of(self)->sync_at = now_ns;
    clock_of(self)->written = 0;
    return nothing();
}

static PyObject *call_told(PyObject *self, PyObject *none)
{
    (void)none;
    int64_t stamp;
    return tell_stamp(clock_of(self), &stamp) ? PyLong_FromLongLong(stamp) : NULL;
}

/* Ask a bound method `told`: 1; 0 if it is something else, -1 for an error. */
int tell_clock(PyObject *asked, int64_t *told)
{
    if (asked->type != &PyCFunction_Type || PyCFunction_GetFunction(asked) != call_told)
        return 0;
    return tell_stamp(clock_of(PyCFunction_GetSelf(asked)), told) ? 1 : -1;
}

/* What was latched last counts as `stamp`. */
static PyObject *call_write(PyObject *self, PyObject *stamp)
{
    DeviceClockObject *clock = clock_of(self);
    int64_t value, at;
    if (!integer(stamp, &value) || !latched_at(clock, clock->device->now, &at))
        return NULL;
    clock->written = value;
    clock->offset_ns += value * clock->unit_ns - local_ns(clock, at);
    return nothing();
}

static PyObject *call_step(PyObject *self, PyObject *step)
{
    int64_t step_ns;
    if (!integer(step, &step_ns))
        return NULL;
    clock_of(self)->offset_ns += step_ns;
    return nothing();
}

static PyObject *call_drift_more(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t drift_ppb, now;
    if (!takes(count, 2, "drift_more") || !integer(arguments[0], &drift_ppb) || !integer(arguments[1], &now))
        return NULL;
    clock_of(self)->offset_ns = local_ns(clock_of(self), now);
    clock_of(self)->started_at = now;
    clock_of(self)->drift_ppb += drift_ppb;
    return nothing();
}

static PyObject *call_local_ns(PyObject *self, PyObject *now)
{
    int64_t now_ns;
    return integer(now, &now_ns) ? PyLong_FromLongLong(local_ns(clock_of(self), now_ns)) : NULL;
}

static PyMethodDef methods[] = {
    {"start", call_start, METH_O, NULL},
    {"told", call_told, METH_NOARGS, NULL},
    {"write", call_write, METH_O, NULL},
    {"local_ns", call_local_ns, METH_O, NULL},
    {"step", call_step, METH_O, NULL},
    {"drift_more", (PyCFunction)(void (*)(void))call_drift_more, METH_FASTCALL, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"at_arrival", T_BOOL, offsetof(DeviceClockObject, at_arrival), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_clock},
    {Py_tp_clear, (void *)clear_clock},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec device_clock_spec = {
    .name = "servobench.virtual_bus.core.native.DeviceClock",
    .basicsize = sizeof(DeviceClockObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
