/* Python's WireFrame (native.pyi). */
#include <stddef.h>

#include "link.h"
#include "types.h"

PyTypeObject *frame_type;

static FrameObject *frame_of(PyObject *self) { return (FrameObject *)self; }

PyObject *call_data_frame(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    (void)module;
    int64_t can_id;
    if (!takes(count, 2, "data_frame") || !integer(arguments[0], &can_id)
        || !is_a(arguments[1], &PyBytes_Type, "octets"))
        return NULL;
    return (PyObject *)make_frame(frame_type, can_id, arguments[1]);
}

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)type;
    static char *fields[] = {"can_id", "data", "extended", "remote", "remote_length", NULL};
    long long can_id, remote_length = 0;
    PyObject *data = NULL;
    int extended = 0, remote = 0;
    if (!PyArg_ParseTupleAndKeywords(arguments, names, "L|SppL:WireFrame", fields, &can_id, &data, &extended, &remote,
                                     &remote_length))
        return NULL;
    FrameObject *frame = make_frame(frame_type, can_id, data);
    if (frame == NULL)
        return NULL;
    frame->extended = extended != 0;
    frame->remote = remote != 0;
    frame->remote_length = remote_length;
    return (PyObject *)frame;
}

static void discard(PyObject *self)
{
    forget(&frame_of(self)->data);
    end_object(self);
}

/* Two frames are equal in all but the hand-over. */
static PyObject *compare(PyObject *self, PyObject *other, int how)
{
    if (other->type != self->type || (how != Py_EQ && how != Py_NE))
        return another(Py_NotImplemented);
    const FrameObject *one = frame_of(self), *two = frame_of(other);
    bool same = one->can_id == two->can_id && one->extended == two->extended && one->remote == two->remote
                && one->remote_length == two->remote_length;
    int equal = same ? PyObject_RichCompareBool(one->data, two->data, Py_EQ) : 0;
    return equal < 0 ? NULL : PyBool_FromLong((how == Py_EQ) == (equal != 0));
}

static Py_ssize_t hash(PyObject *self)
{
    const FrameObject *frame = frame_of(self);
    uint64_t mixed = (uint64_t)PyObject_Hash(frame->data) * 31
                     + (uint64_t)(frame->can_id << 2 | frame->remote << 1 | frame->extended);
    mixed = mixed * 31 + (uint64_t)frame->remote_length;
    return (Py_ssize_t)mixed == -1 ? -2 : (Py_ssize_t)mixed; /* -1 stands for an error */
}

static const char *spelt(bool truth) { return truth ? "True" : "False"; }

static PyObject *show(PyObject *self)
{
    const FrameObject *frame = frame_of(self);
    return PyUnicode_FromFormat("WireFrame(can_id=%lld, data=%R, extended=%s, remote=%s, remote_length=%lld)",
                                (long long)frame->can_id, frame->data, spelt(frame->extended), spelt(frame->remote),
                                (long long)frame->remote_length);
}

static PyMemberDef members[] = {
    {"can_id", T_LONGLONG, offsetof(FrameObject, can_id), READONLY, NULL},
    {"data", T_OBJECT, offsetof(FrameObject, data), READONLY, NULL},
    {"extended", T_BOOL, offsetof(FrameObject, extended), READONLY, NULL},
    {"remote", T_BOOL, offsetof(FrameObject, remote), READONLY, NULL},
    {"remote_length", T_LONGLONG, offsetof(FrameObject, remote_length), READONLY, NULL},
    {"handed_at", T_LONGLONG, offsetof(FrameObject, handed_at), 0, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_richcompare, (void *)compare},
    {Py_tp_hash, (void *)hash},
    {Py_tp_repr, (void *)show},
    {Py_tp_members, members},
    {0},
};

PyType_Spec frame_spec = {
    .name = "servobench.drivers.core.native.WireFrame",
    .basicsize = sizeof(FrameObject),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = slots,
};
