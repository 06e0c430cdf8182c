/* Python's Link (native.pyi). */
#include "link.h"

#include <stddef.h>

#include "types.h"

PyTypeObject *link_type;

static LinkObject *link_of(PyObject *self) { return (LinkObject *)self; }

/* Its arguments are those of the class on top, for its own. */
static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)arguments, (void)names;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    link_of(self)->last = make_frame(frame_type, 0, NULL);
    if (link_of(self)->last == NULL)
        forget(&self);
    return self;
}

static int visit_link(PyObject *self, visitproc visit, void *argument)
{
    LinkObject *link = link_of(self);
    PyObject *held[] = {(PyObject *)self->type, link->port, link->place, link->now, link->failures};
    int result = 0;
    for (size_t which = 0; result == 0 && which < sizeof held / sizeof *held; which++)
        result = visit_one(held[which], visit, argument);
    for (int place = 0; result == 0 && place < link->tap_count; place++) {
        result = visit_one(link->taps[place].tap, visit, argument);
        if (result == 0)
            result = visit_one(link->taps[place].sink, visit, argument);
    }
    return result;
}

static int clear_link(PyObject *self)
{
    LinkObject *link = link_of(self);
    link->way = NULL;
    while (link->tap_count > 0) {
        TapEntry entry = link->taps[--link->tap_count];
        forget(&entry.tap);
        forget(&entry.sink);
    }
    PyObject **held[] = {&link->port, &link->place, &link->now, &link->failures};
    for (size_t which = 0; which < sizeof held / sizeof *held; which++)
        forget(held[which]);
    return 0;
}

static void discard(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    clear_link(self);
    PyObject *last = (PyObject *)link_of(self)->last;
    forget(&last);
    end_object(self);
}

/* The functions behind an object's attribute `native`, and the object itself, its reference the caller's: NULL for
   None. False for an error. */
static bool find_way(PyObject *object, const char *kind, PyObject **place, const void **way)
{
    PyObject *native = PyObject_GetAttrString(object, "native");
    *place = NULL;
    *way = NULL;
    if (native == NULL || native == Py_None) {
        bool well = native != NULL;
        forget(&native);
        return well;
    }
    PyObject *capsule = PyObject_GetAttrString(native, "way");
    const void *found = capsule == NULL ? NULL : PyCapsule_GetPointer(capsule, kind);
    forget(&capsule);
    if (found == NULL) {
        Py_DecRef(native);
        return false;
    }
    *place = native;
    *way = found;
    return true;
}

static bool is_used(const LinkObject *self)
{
    if (self->port == NULL)
        PyErr_Format(PyExc_ValueError, "the link has no port yet");
    return self->port != NULL;
}

static PyObject *call_use(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    LinkObject *link = link_of(self);
    PyObject *place;
    const void *way;
    if (!takes(count, 3, "use") || !is_a(arguments[2], &PyTuple_Type, "a tuple"))
        return NULL;
    if (link->port != NULL)
        return PyErr_Format(PyExc_ValueError, "the link has a port");
    if (!find_way(arguments[0], PORT_WAY, &place, &way))
        return NULL;
    link->port = another(arguments[0]);
    link->now = another(arguments[1]);
    link->failures = another(arguments[2]);
    link->place = place;
    link->way = way;
    return nothing();
}

static PyObject *call_show(PyObject *self, PyObject *tap)
{
    LinkObject *link = link_of(self);
    TapEntry entry;
    const void *way;
    if (!find_way(tap, SINK_WAY, &entry.sink, &way))
        return NULL;
    if (link->tap_count == LINK_TAPS_MAX) {
        forget(&entry.sink);
        return PyErr_Format(PyExc_ValueError, "a link has %d taps at most", LINK_TAPS_MAX);
    }
    entry.tap = another(tap);
    entry.way = way;
    link->taps[link->tap_count++] = entry;
    return nothing();
}

static PyObject *call_fetch(PyObject *self, PyObject *until)
{
    int64_t until_ns;
    if (!is_used(link_of(self)) || !integer(until, &until_ns))
        return NULL;
    int fetched = fetch(link_of(self), until_ns);
    return fetched < 0 ? NULL : PyBool_FromLong(fetched);
}

static PyObject *call_send(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t can_id;
    if (!takes(count, 2, "send") || !is_used(link_of(self)) || !integer(arguments[0], &can_id)
        || !is_a(arguments[1], &PyBytes_Type, "octets"))
        return NULL;
    FrameObject *frame = make_frame(frame_type, can_id, arguments[1]);
    PyObject *at = frame == NULL ? NULL : hand_over(link_of(self), frame);
    if (frame != NULL)
        Py_DecRef((PyObject *)frame);
    return at;
}

static PyObject *call_hand_over(PyObject *self, PyObject *frame)
{
    if (!is_used(link_of(self)) || !is_a(frame, frame_type, "a WireFrame"))
        return NULL;
    return hand_over(link_of(self), (FrameObject *)frame);
}

static PyObject *call_offer(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    if (!takes(count, 2, "offer") || !is_used(link_of(self)) || !is_a(arguments[0], frame_type, "a WireFrame"))
        return NULL;
    int taken = offer(link_of(self), (FrameObject *)arguments[0], arguments[1]);
    return taken < 0 ? NULL : PyBool_FromLong(taken);
}

static PyObject *get_needs_watching(PyObject *self, void *none)
{
    (void)none;
    int needs = is_used(link_of(self)) ? needs_watching(link_of(self)) : -1;
    return needs < 0 ? NULL : PyBool_FromLong(needs);
}

static PyObject *get_last_id(PyObject *self, void *none)
{
    (void)none;
    return PyLong_FromLongLong(link_of(self)->last->can_id);
}

static PyObject *get_last_data(PyObject *self, void *none)
{
    (void)none;
    return another(link_of(self)->last->data);
}

static PyObject *get_last_handed_at(PyObject *self, void *none)
{
    (void)none;
    return PyLong_FromLongLong(link_of(self)->last->handed_at);
}

static PyMethodDef methods[] = {
    {"use", (PyCFunction)(void (*)(void))call_use, METH_FASTCALL, NULL},
    {"show", call_show, METH_O, NULL},
    {"fetch", call_fetch, METH_O, NULL},
    {"send", (PyCFunction)(void (*)(void))call_send, METH_FASTCALL, NULL},
    {"hand_over", call_hand_over, METH_O, NULL},
    {"offer", (PyCFunction)(void (*)(void))call_offer, METH_FASTCALL, NULL},
    {0},
};

static PyGetSetDef attributes[] = {
    {"needs_watching", get_needs_watching, NULL, NULL, NULL},
    {"last_id", get_last_id, NULL, NULL, NULL},
    {"last_data", get_last_data, NULL, NULL, NULL},
    {"last_handed_at", get_last_handed_at, NULL, NULL, NULL},
    {0},
};

#define PLACE(path) offsetof(LinkObject, path)

static PyMemberDef members[] = {
    {"port", T_OBJECT, PLACE(port), READONLY, NULL},
    {"waits", T_BOOL, PLACE(waits), 0, NULL},
    {"sent_frames", T_LONGLONG, PLACE(sent_frames), 0, NULL},
    {"received_frames", T_LONGLONG, PLACE(received_frames), 0, NULL},
    {"echoed_frames", T_LONGLONG, PLACE(echoed_frames), 0, NULL},
    {"ignored_frames", T_LONGLONG, PLACE(ignored_frames), 0, NULL},
    {"error_frames", T_LONGLONG, PLACE(error_frames), 0, NULL},
    {"last_at", T_LONGLONG, PLACE(last_at), READONLY, NULL},
    {"last_own", T_BOOL, PLACE(last_own), READONLY, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_traverse, (void *)visit_link},
    {Py_tp_clear, (void *)clear_link},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_getset, attributes},
    {Py_tp_members, members},
    {0},
};

PyType_Spec link_spec = {
    .name = "servobench.drivers.core.native.Link",
    .basicsize = sizeof(LinkObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    .slots = slots,
};
