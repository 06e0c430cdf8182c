/* Python's Queue, Route, EntryBlock and Fates (native.pyi). */
#include <stddef.h>

#include "faults.h"
#include "objects.h"
#include "types.h"

PyTypeObject *queue_type, *route_type, *block_type, *fates_type;

static RouteObject *route_of(PyObject *self) { return (RouteObject *)self; }

static BlockObject *block_of(PyObject *self) { return (BlockObject *)self; }

static FatesObject *fates_of(PyObject *self) { return (FatesObject *)self; }

/* ---- Queue ---- */

static PyObject *make_queue(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    return takes_between(arguments, names, 0, 0, "Queue") ? PyType_GenericAlloc(type, 0) : NULL;
}

static PyObject *call_behind(PyObject *self, PyObject *instant)
{
    int64_t release;
    return integer(instant, &release) ? PyLong_FromLongLong(release_behind((QueueObject *)self, release)) : NULL;
}

static PyMethodDef queue_methods[] = {
    {"behind", call_behind, METH_O, NULL},
    {0},
};

static PyMemberDef queue_members[] = {
    {"released_at", T_LONGLONG, offsetof(QueueObject, released_at), 0, NULL},
    {0},
};

static PyType_Slot queue_slots[] = {
    {Py_tp_new, (void *)make_queue},
    {Py_tp_dealloc, (void *)end_object},
    {Py_tp_methods, queue_methods},
    {Py_tp_members, queue_members},
    {0},
};

PyType_Spec queue_spec = {
    .name = "servobench.virtual_bus.core.native.Queue",
    .basicsize = sizeof(QueueObject),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = queue_slots,
};

/* ---- Route ---- */

static PyObject *tuple_of(PyObject *objects, PyTypeObject *type, const char *expected)
{
    PyObject *tuple = PySequence_Tuple(objects);
    for (Py_ssize_t place = 0; tuple != NULL && place < PyTuple_Size(tuple); place++)
        if (!is_a(PyTuple_GetItem(tuple, place), type, expected))
            forget(&tuple);
    return tuple;
}

/* The first three arguments; the others are those of a Python class on top of it. */
static PyObject *make_route(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)names;
    if (PyTuple_Size(arguments) < 3)
        return PyErr_Format(PyExc_TypeError, "Route() takes a queue, strikes and holds, %zd arguments were given",
                            PyTuple_Size(arguments));
    PyObject *queue = PyTuple_GetItem(arguments, 0);
    int own_meet = is_overridden(type, route_type, "meet");
    if (own_meet < 0 || (is_there(queue) && !is_a(queue, queue_type, "a Queue or None")))
        return NULL;
    PyObject *strikes = tuple_of(PyTuple_GetItem(arguments, 1), strike_type, "a Strike");
    PyObject *holds = strikes == NULL ? NULL : tuple_of(PyTuple_GetItem(arguments, 2), hold_type, "a Hold");
    PyObject *self = holds == NULL ? NULL : PyType_GenericAlloc(type, 0);
    if (self == NULL) {
        forget(&strikes);
        forget(&holds);
        return NULL;
    }
    RouteObject *route = route_of(self);
    route->strikes = strikes;
    route->holds = holds;
    route->own_meet = own_meet > 0;
    if (is_there(queue))
        route->queue = (QueueObject *)another(queue);
    return self;
}

static int visit_route(PyObject *self, visitproc visit, void *argument)
{
    const RouteObject *route = route_of(self);
    PyObject *held[] = {(PyObject *)self->type, (PyObject *)route->queue, route->strikes, route->holds, route->struck};
    int result = 0;
    for (size_t which = 0; !result && which < sizeof held / sizeof *held; which++)
        result = visit_one(held[which], visit, argument);
    return result;
}

/* No clear: a circle through a route goes through a strike, a hold or its class's own attributes. */
static void discard_route(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    RouteObject *route = route_of(self);
    forget((PyObject **)&route->queue);
    forget(&route->strikes);
    forget(&route->holds);
    forget(&route->struck);
    end_object(self);
}

static PyObject *call_meet(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t elapsed, n, held_ns;
    RouteObject *route = route_of(self);
    bool own = route->own_meet;
    if (!takes(count, 2, "meet") || !integer(arguments[0], &elapsed) || !integer(arguments[1], &n))
        return NULL;
    route->own_meet = false;
    bool well = meet_frame(route, elapsed, n, &held_ns);
    route->own_meet = own;
    return well ? PyLong_FromLongLong(held_ns) : NULL;
}

static PyMethodDef route_methods[] = {
    {"meet", (PyCFunction)(void (*)(void))call_meet, METH_FASTCALL, NULL},
    {0},
};

static PyMemberDef route_members[] = {
    {"queue", T_OBJECT, offsetof(RouteObject, queue), READONLY, NULL},
    {"seen", T_LONGLONG, offsetof(RouteObject, seen), 0, NULL},
    {"struck", T_OBJECT, offsetof(RouteObject, struck), 0, NULL},
    {"number", T_LONGLONG, offsetof(RouteObject, number), 0, NULL},
    {0},
};

static PyType_Slot route_slots[] = {
    {Py_tp_new, (void *)make_route},
    {Py_tp_traverse, (void *)visit_route},
    {Py_tp_dealloc, (void *)discard_route},
    {Py_tp_methods, route_methods},
    {Py_tp_members, route_members},
    {0},
};

PyType_Spec route_spec = {
    .name = "servobench.virtual_bus.core.native.Route",
    .basicsize = sizeof(RouteObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    .slots = route_slots,
};

/* ---- EntryBlock ---- */

static PyObject *make_block(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)arguments, (void)names; /* those of a Python class on top of it */
    return PyType_GenericAlloc(type, 0);
}

/* note(code, at_ns, link, can_id, n, a=0, b=0, c=0); in the entry they have the order of FaultEntry. */
static PyObject *call_note(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    static const int places[ENTRY_NUMBERS] = {6, 0, 7, 4, 5, 1, 2, 3};
    int64_t entry[ENTRY_NUMBERS] = {0};
    if (count < 5 || count > ENTRY_NUMBERS)
        return PyErr_Format(PyExc_TypeError, "note() takes 5 to 8 arguments, %zd were given", count);
    for (Py_ssize_t place = 0; place < count; place++)
        if (!integer(arguments[place], &entry[places[place]]))
            return NULL;
    return note_entry(block_of(self), entry) ? nothing() : NULL;
}

static PyObject *call_take(PyObject *self, PyObject *none)
{
    (void)none;
    BlockObject *block = block_of(self);
    Py_ssize_t length = (Py_ssize_t)((size_t)block->filled * sizeof block->entries[0]);
    PyObject *octets = PyBytes_FromStringAndSize((const char *)block->entries, length);
    if (octets != NULL)
        block->filled = 0;
    return octets;
}

static PyObject *call_flush(PyObject *self, PyObject *none)
{
    (void)self, (void)none;
    return PyErr_Format(PyExc_NotImplementedError, "flush");
}

static PyMethodDef block_methods[] = {
    {"note", (PyCFunction)(void (*)(void))call_note, METH_FASTCALL, NULL},
    {"take", call_take, METH_NOARGS, NULL},
    {"flush", call_flush, METH_NOARGS, NULL},
    {0},
};

static PyType_Slot block_slots[] = {
    {Py_tp_new, (void *)make_block},
    {Py_tp_dealloc, (void *)end_object},
    {Py_tp_methods, block_methods},
    {0},
};

PyType_Spec block_spec = {
    .name = "servobench.virtual_bus.core.native.EntryBlock",
    .basicsize = sizeof(BlockObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE,
    .slots = block_slots,
};

/* ---- Fates ---- */

static PyObject *make_fates(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)arguments, (void)names; /* those of a Python class on top of it */
    return PyType_GenericAlloc(type, 0);
}

/* Fates(log, place, delay_code) */
static int set_fates(PyObject *self, PyObject *arguments, PyObject *names)
{
    FatesObject *fates = fates_of(self);
    if (!takes_between(arguments, names, 3, 3, "Fates"))
        return -1;
    PyObject *log = PyTuple_GetItem(arguments, 0);
    if ((is_there(log) && !is_a(log, block_type, "an EntryBlock or None"))
        || !integer(PyTuple_GetItem(arguments, 1), &fates->place)
        || !integer(PyTuple_GetItem(arguments, 2), &fates->delay_code))
        return -1;
    PyObject *before = (PyObject *)fates->log;
    fates->log = is_there(log) ? (BlockObject *)another(log) : NULL;
    forget(&before);
    return 0;
}

static int visit_fates(PyObject *self, visitproc visit, void *argument)
{
    const FatesObject *fates = fates_of(self);
    int result = visit((PyObject *)self->type, argument);
    if (!result)
        result = visit_one((PyObject *)fates->log, visit, argument);
    for (int way = 0; !result && way < WAYS; way++)
        for (int can_id = 0; !result && can_id < STANDARD_IDS; can_id++)
            result = visit_one((PyObject *)fates->ways[way].routes[can_id], visit, argument);
    return result;
}

static int clear_fates(PyObject *self)
{
    forget((PyObject **)&fates_of(self)->log);
    forget_routes(fates_of(self));
    return 0;
}

static void discard_fates(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    clear_fates(self);
    end_object(self);
}

static PyObject *call_start(PyObject *self, PyObject *instant)
{
    FatesObject *fates = fates_of(self);
    if (!integer(instant, &fates->zero))
        return NULL;
    forget_routes(fates);
    for (int way = 0; way < WAYS; way++)
        fates->ways[way].frames = fates->ways[way].delayed = 0;
    fates->acts = true;
    return nothing();
}

static PyObject *call_stop(PyObject *self, PyObject *none)
{
    (void)none;
    fates_of(self)->acts = false;
    return nothing();
}

static PyObject *call_hold(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t way, held_ns;
    JudgedFrame frame;
    if (!takes(count, 4, "hold") || !integer(arguments[0], &way) || !integer(arguments[1], &frame.can_id)
        || !integer(arguments[2], &frame.now))
        return NULL;
    int extended = PyObject_IsTrue(arguments[3]);
    if (extended < 0)
        return NULL;
    int64_t ids = extended ? (int64_t)1 << 29 : STANDARD_IDS;
    if (way < 0 || way >= WAYS || frame.can_id < 0 || frame.can_id >= ids)
        return PyErr_Format(PyExc_ValueError, "way %lld, identifier %lld: 0 or 1, and below %lld, expected",
                            (long long)way, (long long)frame.can_id, (long long)ids);
    frame.way = (int)way;
    frame.extended = extended > 0;
    return fate_of(fates_of(self), &frame, &held_ns) ? PyLong_FromLongLong(held_ns) : NULL;
}

/* tally(way): frames seen, those delayed */
static PyObject *call_tally(PyObject *self, PyObject *argument)
{
    int64_t way;
    if (!integer(argument, &way))
        return NULL;
    if (way < 0 || way >= WAYS)
        return PyErr_Format(PyExc_ValueError, "way %lld: 0 or 1 expected", (long long)way);
    PyObject *pair = PyTuple_New(2);
    if (pair != NULL) {
        PyTuple_SetItem(pair, 0, PyLong_FromLongLong(fates_of(self)->ways[way].frames));
        PyTuple_SetItem(pair, 1, PyLong_FromLongLong(fates_of(self)->ways[way].delayed));
    }
    return pair;
}

static PyMethodDef fates_methods[] = {
    {"start", call_start, METH_O, NULL},
    {"stop", call_stop, METH_NOARGS, NULL},
    {"hold", (PyCFunction)(void (*)(void))call_hold, METH_FASTCALL, NULL},
    {"tally", call_tally, METH_O, NULL},
    {0},
};

static PyMemberDef fates_members[] = {
    {"log", T_OBJECT, offsetof(FatesObject, log), READONLY, NULL},
    {"zero", T_LONGLONG, offsetof(FatesObject, zero), READONLY, NULL},
    {0},
};

static PyType_Slot fates_slots[] = {
    {Py_tp_new, (void *)make_fates},
    {Py_tp_init, (void *)set_fates},
    {Py_tp_traverse, (void *)visit_fates},
    {Py_tp_clear, (void *)clear_fates},
    {Py_tp_dealloc, (void *)discard_fates},
    {Py_tp_methods, fates_methods},
    {Py_tp_members, fates_members},
    {0},
};

PyType_Spec fates_spec = {
    .name = "servobench.virtual_bus.core.native.Fates",
    .basicsize = sizeof(FatesObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    .slots = fates_slots,
};
