/* Order at a SYNC: the application advances; earlier changes are sent; the synchronous TPDOs are sampled; the
   synchronous RPDOs that were waiting are applied; the application hears of the SYNC. */
#include "device.h"

#include <assert.h>

#include "attributes.h"
#include "types.h"

/* ---- frames out ---- */

/* Takes a reference of its own. */
bool queue_frame(DeviceObject *self, PyObject *frame)
{
    if (self->out_count == self->out_room) {
        int room = self->out_room ? 2 * self->out_room : 8;
        PyObject **out = PyMem_Realloc(self->out, (size_t)room * sizeof *out);
        if (out == NULL) {
            PyErr_NoMemory();
            return false;
        }
        self->out = out;
        self->out_room = room;
    }
    assert(self->out_count < self->out_room);
    self->out[self->out_count++] = another(frame);
    return true;
}

/* ---- the application ---- */

static bool call_method_at(PyObject *object, const char *spelt, PyObject **name, int64_t now)
{
    if (*name == NULL && (*name = PyUnicode_InternFromString(spelt)) == NULL)
        return false;
    PyObject *arguments[] = {object, PyLong_FromLongLong(now)};
    bool well = arguments[1] != NULL && went_well(PyObject_VectorcallMethod(*name, arguments, 2, NULL));
    forget(&arguments[1]);
    return well;
}

/* Bring what is behind the device to `now`, the instant of an entry. */
bool advance_application(DeviceObject *self, int64_t now)
{
    static PyObject *name;
    self->now = now;
    if (self->drive == NULL)
        return call_method_at(self->application, "advance", &name, now);
    PyObject *drive = another((PyObject *)self->drive);
    bool well = advance_drive((DriveObject *)drive, now);
    Py_DecRef(drive);
    return well;
}

static bool tell_application_of_sync(DeviceObject *self, int64_t counter, int64_t now)
{
    static PyObject *name;
    if (self->drive != NULL && !self->drive->awaits_sync)
        return true;
    if (name == NULL && (name = PyUnicode_InternFromString("on_sync")) == NULL)
        return false;
    PyObject *arguments[] = {self->application, PyLong_FromLongLong(counter), PyLong_FromLongLong(now)};
    bool well = arguments[1] != NULL && arguments[2] != NULL
                && went_well(PyObject_VectorcallMethod(name, arguments, 3, NULL));
    forget(&arguments[1]);
    forget(&arguments[2]);
    return well;
}

static int64_t wish_of_application(DeviceObject *self, bool *well)
{
    static Attribute wake_at = {.spelt = "wake_at"};
    int64_t wish = never_ns;
    if (self->drive != NULL)
        return self->drive->wake_at;
    PyObject *told = attribute(&wake_at, self->application);
    *well = told != NULL && integer(told, &wish);
    forget(&told);
    return wish;
}

/* ---- PDOs ---- */

bool is_watching(const DeviceObject *self) { return PyList_Size(self->watching) > 0; }

/* Something may have changed: those TPDOs that watch see for themselves. */
bool look_for_changes(DeviceObject *self)
{
    bool runs = false;
    for (Py_ssize_t place = 0; place < PyList_Size(self->watching); place++) {
        PyObject *tpdo = another(PyList_GetItem(self->watching, place));
        bool well = look_at_tpdo((TpdoObject *)tpdo);
        runs = runs || ((TpdoObject *)tpdo)->runs;
        Py_DecRef(tpdo);
        if (!well)
            return false;
    }
    self->look_at = runs ? self->now + LOOK_NS : never_ns;
    return true;
}

static bool sync_transmit(PyObject *tpdos, int64_t counter)
{
    for (Py_ssize_t place = 0; place < PyTuple_Size(tpdos); place++) {
        TpdoObject *tpdo = (TpdoObject *)PyTuple_GetItem(tpdos, place);
        if (tpdo->follows_sync && !tpdo_at_sync(tpdo, counter))
            return false;
    }
    return true;
}

static bool sync_receive(PyObject *rpdos)
{
    for (Py_ssize_t place = 0; place < PyTuple_Size(rpdos); place++) {
        RpdoObject *rpdo = (RpdoObject *)PyTuple_GetItem(rpdos, place);
        if (rpdo->waiting != NULL && !actuate_rpdo(rpdo))
            return false;
    }
    return true;
}

static bool sync_pdos(DeviceObject *self, int64_t counter)
{
    if (!self->operational)
        return true;
    PyObject *tpdos = another(self->transmit), *rpdos = another(self->receive);
    bool well = (!is_watching(self) || look_for_changes(self)) && sync_transmit(tpdos, counter) && sync_receive(rpdos);
    Py_DecRef(rpdos);
    Py_DecRef(tpdos);
    return well;
}

/* Act on a SYNC; `counter`: 0 without one. */
bool sync_device(DeviceObject *self, int64_t counter)
{
    return sync_pdos(self, counter) && tell_application_of_sync(self, counter, self->now);
}

/* ---- frames in ---- */

static bool hand_to_handler(PyObject *handler, FrameObject *frame, int64_t now)
{
    if (handler->type == rpdo_type)
        return take_rpdo((RpdoObject *)handler, frame, now);
    if (handler->type == sync_type)
        return take_sync((SyncObject *)handler, frame, now);
    PyObject *arguments[] = {(PyObject *)frame, PyLong_FromLongLong(now)};
    bool well = arguments[1] != NULL && went_well(PyObject_Vectorcall(handler, arguments, 2, NULL));
    forget(&arguments[1]);
    return well;
}

/* A frame that `handlers`, a tuple, listen to; not while the device boots. */
bool hear_by_device(DeviceObject *self, PyObject *handlers, FrameObject *frame, int64_t now)
{
    if (!advance_application(self, now))
        return false;
    for (Py_ssize_t place = 0; place < PyTuple_Size(handlers); place++) {
        if (!hand_to_handler(PyTuple_GetItem(handlers, place), frame, now))
            return false;
    }
    return !is_watching(self) || look_for_changes(self);
}

/* The earliest timer of the device or wish of its application; now, if frames are waiting; NEVER. */
int64_t due_of_device(DeviceObject *self, bool *well)
{
    *well = true;
    if (self->out_count > 0 && !self->mute)
        return self->now;
    int64_t due = self->next_timer;
    if (is_watching(self) && self->look_at < due)
        due = self->look_at;
    int64_t wish = wish_of_application(self, well);
    return wish < due ? wish : due;
}
