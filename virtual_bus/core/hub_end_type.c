/* Python's HubEnd (native.pyi): a client's end of its connection to a hub, a socket that keeps packets apart. */
#define _GNU_SOURCE /* recvmmsg, ppoll */
#include <assert.h>
#include <errno.h>
#include <poll.h>
#include <stddef.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>

#include "hub_record.h"
#include "port_way.h"
#include "types.h"

enum { PACKETS = 4 }; /* read by one call; fewer say that no further one is there */

typedef struct HubEndObject {
    PyObject head;
    PyObject *owner, *accepts; /* told of what is rare; the filter, or None */
    int descriptor;            /* -1: closed */
    bool bus_off;
    int64_t emptied_at; /* when the last read left nothing; it saves one further look, and is forgotten then */
    unsigned char *kept; /* records that have come */
    size_t room, first, end;
} HubEndObject;

static HubEndObject *end_of(PyObject *self) { return (HubEndObject *)self; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    int64_t descriptor;
    if (!takes_between(arguments, names, 2, 2, "HubEnd") || !integer(PyTuple_GetItem(arguments, 0), &descriptor))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    end_of(self)->descriptor = (int)descriptor;
    end_of(self)->owner = another(PyTuple_GetItem(arguments, 1));
    end_of(self)->emptied_at = INT64_MIN;
    return self;
}

static int visit_end(PyObject *self, visitproc visit, void *argument)
{
    PyObject *held[] = {(PyObject *)self->type, end_of(self)->owner, end_of(self)->accepts};
    int result = 0;
    for (size_t which = 0; result == 0 && which < sizeof held / sizeof *held; which++)
        result = visit_one(held[which], visit, argument);
    return result;
}

static int clear_end(PyObject *self)
{
    forget(&end_of(self)->owner);
    forget(&end_of(self)->accepts);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    clear_end(self);
    PyMem_Free(end_of(self)->kept);
    end_object(self);
}

/* ---- what is rare ---- */

/* Call a method of the owner, once its name is made; `argument`: NULL for none, and its reference goes. */
static bool tell(HubEndObject *self, const char *spelt, PyObject **name, PyObject *argument)
{
    PyObject *owner = another(self->owner != NULL ? self->owner : Py_None);
    PyObject *arguments[] = {owner, argument};
    bool well = *name != NULL || (*name = PyUnicode_InternFromString(spelt)) != NULL;
    well = well && went_well(PyObject_VectorcallMethod(*name, arguments, argument == NULL ? 1 : 2, NULL));
    forget(&argument);
    Py_DecRef(owner);
    return well;
}

/* Always false, with an error set. `error`: the system's number; 0: the other end is closed, or this one. */
static bool fail(HubEndObject *self, int error)
{
    static PyObject *name;
    PyObject *number = PyLong_FromLongLong(error);
    if (number != NULL && tell(self, "failed", &name, number))
        PyErr_Format(PyExc_RuntimeError, "failed: it must raise");
    return false;
}

static bool note(HubEndObject *self, const unsigned char *packet, size_t length)
{
    static PyObject *name;
    PyObject *octets = PyBytes_FromStringAndSize((const char *)packet, (Py_ssize_t)length);
    return octets != NULL && tell(self, "note", &name, octets);
}

/* 1, 0, or -1 for an error. */
static int is_accepted(const HubEndObject *self, const Arrived *arrived)
{
    if (!is_there(self->accepts))
        return 1;
    PyObject *accepts = another(self->accepts), *arguments[] = {(PyObject *)arrived->frame};
    PyObject *said = PyObject_Vectorcall(accepts, arguments, 1, NULL);
    int accepted = said == NULL ? -1 : PyObject_IsTrue(said);
    forget(&said);
    Py_DecRef(accepts);
    return accepted;
}

/* ---- packets ---- */

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

/* Wait for a packet: 1; 0 once `until` has come without one, -1 for an error. Another thread may take it. */
static int wait_for_packet(HubEndObject *self, int64_t until)
{
    for (;;) {
        int64_t left = until - now_ns();
        if (left <= 0)
            return 0;
        struct timespec limit = {.tv_sec = (time_t)(left / 1000000000), .tv_nsec = (long)(left % 1000000000)};
        struct pollfd asked = {.fd = self->descriptor, .events = POLLIN};
        if (asked.fd < 0)
            return fail(self, 0) - 1;
        void *thread = PyEval_SaveThread();
        int ready = ppoll(&asked, 1, &limit, NULL), error = errno;
        PyEval_RestoreThread(thread);
        if (ready > 0)
            return 1;
        if (ready < 0 && error != EINTR)
            return fail(self, error) - 1;
        if (ready < 0 && PyErr_CheckSignals() < 0)
            return -1;
    }
}

static bool keep(HubEndObject *self, const unsigned char *packet, size_t length)
{
    if (self->room - self->end < length) {
        size_t room = 2 * self->end + PACKETS * HUB_PACKET_BYTES_MAX;
        unsigned char *kept = PyMem_Realloc(self->kept, room);
        if (kept == NULL)
            return PyErr_NoMemory() != NULL;
        self->kept = kept;
        self->room = room;
    }
    memcpy(self->kept + self->end, packet, length);
    self->end += length;
    return true;
}

/* Read what is there, without waiting. */
static bool take_in(HubEndObject *self)
{
    unsigned char octets[PACKETS][HUB_PACKET_BYTES_MAX];
    struct iovec places[PACKETS];
    struct mmsghdr packets[PACKETS];
    memset(packets, 0, sizeof packets);
    for (int which = 0; which < PACKETS; which++) {
        places[which] = (struct iovec){octets[which], HUB_PACKET_BYTES_MAX};
        packets[which].msg_hdr.msg_iov = &places[which];
        packets[which].msg_hdr.msg_iovlen = 1;
    }
    int64_t now = now_ns();
    int count = self->descriptor < 0 ? 0 : recvmmsg(self->descriptor, packets, PACKETS, MSG_DONTWAIT, NULL);
    if (count == 0 || (count < 0 && errno != EAGAIN))
        return fail(self, count == 0 ? 0 : errno);
    bool well = true, closed = false;
    for (int which = 0; well && !closed && which < count; which++) {
        size_t length = packets[which].msg_len;
        closed = length == 0;
        well = length % HUB_FRAME_BYTES == 0 ? keep(self, octets[which], length) : note(self, octets[which], length);
    }
    if (well && closed && self->first == self->end) /* told once all that came before is handed on */
        return fail(self, 0);
    if (!closed && count < PACKETS)
        self->emptied_at = now;
    return well;
}

static int receive(PyObject *object, int64_t until, Arrived *arrived)
{
    HubEndObject *self = end_of(object);
    for (;;) {
        while (self->first < self->end) {
            assert(self->first + HUB_FRAME_BYTES <= self->end && self->end <= self->room);
            const unsigned char *record = self->kept + self->first;
            self->first += HUB_FRAME_BYTES;
            if (!unpack_record(record, arrived))
                return -1;
            int accepted = is_accepted(self, arrived);
            if (accepted > 0)
                return 1;
            Py_DecRef((PyObject *)arrived->frame);
            if (accepted < 0)
                return -1;
        }
        self->first = self->end = 0;
        bool empty = until <= self->emptied_at;
        self->emptied_at = INT64_MIN;
        if (empty)
            return 0;
        int ready = until > now_ns() ? wait_for_packet(self, until) : 1;
        if (ready <= 0)
            return ready;
        if (!take_in(self))
            return -1;
    }
}

static bool transmit(PyObject *object, FrameObject *frame)
{
    static PyObject *name;
    HubEndObject *self = end_of(object);
    unsigned char octets[HUB_FRAME_BYTES];
    if (!pack_record((PyObject *)frame, 0, false, octets))
        return false;
    if (self->descriptor < 0)
        return fail(self, 0);
    if (send(self->descriptor, octets, sizeof octets, MSG_DONTWAIT | MSG_NOSIGNAL) < 0)
        return fail(self, errno);
    return !self->bus_off || tell(self, "check_state", &name, NULL);
}

static const PortWay way = {receive, transmit};

static PyObject *call_receive(PyObject *self, PyObject *until) { return receive_by(&way, self, until); }

static PyObject *call_transmit(PyObject *self, PyObject *frame) { return transmit_by(&way, self, frame); }

static PyObject *call_take_in(PyObject *self, PyObject *until)
{
    int64_t until_ns;
    int ready = integer(until, &until_ns) ? wait_for_packet(end_of(self), until_ns) : -1;
    return ready < 0 || (ready > 0 && !take_in(end_of(self))) ? NULL : nothing();
}

static PyObject *call_close(PyObject *self, PyObject *none)
{
    (void)none;
    end_of(self)->descriptor = -1;
    end_of(self)->emptied_at = INT64_MIN;
    return nothing();
}

static PyMethodDef methods[] = {
    {"receive", call_receive, METH_O, NULL},
    {"transmit", call_transmit, METH_O, NULL},
    {"take_in", call_take_in, METH_O, NULL},
    {"close", call_close, METH_NOARGS, NULL},
    {0},
};

static PyGetSetDef attributes[] = {
    {"way", show_way, NULL, NULL, (void *)&way},
    {0},
};

static PyMemberDef members[] = {
    {"accepts", T_OBJECT, offsetof(HubEndObject, accepts), 0, NULL},
    {"bus_off", T_BOOL, offsetof(HubEndObject, bus_off), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_end},
    {Py_tp_clear, (void *)clear_end},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_getset, attributes},
    {Py_tp_members, members},
    {0},
};

PyType_Spec hub_end_spec = {
    .name = "servobench.virtual_bus.core.native.HubEnd",
    .basicsize = sizeof(HubEndObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
