/* What becomes of a frame: struck, held behind those in front of it, or passed; and the log of it.

       fate_of -- route of its COB-ID --> strikes and holds --> struck: Python's `strike`
                                                            --> held: behind its queue, into the log */
#include <assert.h>
#include <string.h>

#include "faults.h"
#include "objects.h"

static const int64_t EXTENDED_FLAG = (int64_t)1 << 31; /* servobench.drivers.wire.frame_port */

/* `release`, or later if the one in front is held for longer; the next one waits for it. */
int64_t release_behind(QueueObject *self, int64_t release)
{
    if (release > self->released_at)
        self->released_at = release;
    return self->released_at;
}

/* ---- route ---- */

/* For a Python class on top of it, which sets `struck` and `number` itself. */
static bool meet_own(RouteObject *self, int64_t elapsed, int64_t n, int64_t *held_ns)
{
    static PyObject *name;
    if (name == NULL && (name = PyUnicode_InternFromString("meet")) == NULL)
        return false;
    PyObject *arguments[] = {(PyObject *)self, PyLong_FromLongLong(elapsed), PyLong_FromLongLong(n)};
    bool well = arguments[1] != NULL && arguments[2] != NULL;
    PyObject *held = well ? PyObject_VectorcallMethod(name, arguments, 3, NULL) : NULL;
    well = held != NULL && integer(held, held_ns);
    forget(&held);
    forget(&arguments[1]);
    forget(&arguments[2]);
    return well;
}

/* For how many ns the `n`-th frame is held, and what strikes it; asked once for each. False for an error. */
bool meet_frame(RouteObject *self, int64_t elapsed, int64_t n, int64_t *held_ns)
{
    if (self->own_meet)
        return meet_own(self, elapsed, n, held_ns);
    StrikeObject *first = NULL;
    for (Py_ssize_t place = 0; place < PyTuple_Size(self->strikes); place++) {
        StrikeObject *strike = (StrikeObject *)PyTuple_GetItem(self->strikes, place);
        bool struck;
        if (!strikes_frame(strike, elapsed, &struck))
            return false;
        if (struck && first == NULL)
            first = strike;
    }
    *held_ns = 0;
    for (Py_ssize_t place = 0; place < PyTuple_Size(self->holds); place++) {
        int64_t longer_ns;
        if (!holds_frame((HoldObject *)PyTuple_GetItem(self->holds, place), elapsed, &longer_ns))
            return false;
        *held_ns += longer_ns;
    }
    forget(&self->struck);
    if (first == NULL)
        return true;
    self->struck = another(first->kind);
    return number_of_strike(first, &self->number);
}

/* ---- log ---- */

static bool flush(BlockObject *self)
{
    static PyObject *name;
    if (name == NULL && (name = PyUnicode_InternFromString("flush")) == NULL)
        return false;
    PyObject *arguments[] = {another((PyObject *)self)};
    bool well = went_well(PyObject_VectorcallMethod(name, arguments, 1, NULL));
    Py_DecRef(arguments[0]);
    return well;
}

bool note_entry(BlockObject *self, const int64_t *entry)
{
    if (self->filled == BLOCK_ENTRIES) {
        PyErr_Format(PyExc_ValueError, "flush() left the block full: take() expected in it");
        return false;
    }
    assert(0 <= self->filled && self->filled < BLOCK_ENTRIES);
    memcpy(self->entries[self->filled++], entry, sizeof self->entries[0]);
    return self->filled < BLOCK_ENTRIES || flush(self);
}

/* ---- fate ---- */

void forget_routes(FatesObject *self)
{
    for (int way = 0; way < WAYS; way++)
        for (int can_id = 0; can_id < STANDARD_IDS; can_id++)
            forget((PyObject **)&self->ways[way].routes[can_id]);
}

/* A reference to what Python's `name(way, can_id, extended)` gives. */
static PyObject *ask_route(FatesObject *self, PyObject **name, const char *text, const JudgedFrame *frame)
{
    if (*name == NULL && (*name = PyUnicode_InternFromString(text)) == NULL)
        return NULL;
    PyObject *arguments[] = {(PyObject *)self, PyLong_FromLongLong(frame->way), PyLong_FromLongLong(frame->can_id),
                             PyBool_FromLong(frame->extended)};
    bool well = arguments[1] != NULL && arguments[2] != NULL;
    PyObject *given = well ? PyObject_VectorcallMethod(*name, arguments, 4, NULL) : NULL;
    for (int place = 1; place < 4; place++)
        forget(&arguments[place]);
    return given;
}

static RouteObject *checked_route(PyObject *given)
{
    if (given != NULL && !is_a(given, route_type, "a Route"))
        forget(&given);
    return (RouteObject *)given;
}

/* A reference to the route of a standard frame, and which frame it is of its COB-ID. */
static RouteObject *standard_route(FatesObject *self, const JudgedFrame *frame, int64_t *n)
{
    static PyObject *name;
    assert(0 <= frame->way && frame->way < WAYS && 0 <= frame->can_id && frame->can_id < STANDARD_IDS);
    RouteObject *route = (RouteObject *)self->ways[frame->way].routes[frame->can_id];
    if (route != NULL) {
        Py_IncRef((PyObject *)route);
    } else {
        route = checked_route(ask_route(self, &name, "route", frame));
        if (route == NULL)
            return NULL;
        PyObject *before = (PyObject *)self->ways[frame->way].routes[frame->can_id];
        self->ways[frame->way].routes[frame->can_id] = (RouteObject *)another((PyObject *)route);
        forget(&before);
    }
    *n = route->seen++;
    return route;
}

/* The same of an extended frame, of which Python keeps the routes and the counts: they are rare. */
static RouteObject *extended_route(FatesObject *self, const JudgedFrame *frame, int64_t *n)
{
    static PyObject *name;
    PyObject *given = ask_route(self, &name, "extended_route", frame);
    PyObject *pair = given == NULL ? NULL : PySequence_Tuple(given);
    forget(&given);
    bool well = pair != NULL && takes(PyTuple_Size(pair), 2, "extended_route") && integer(PyTuple_GetItem(pair, 1), n);
    RouteObject *route = well ? checked_route(another(PyTuple_GetItem(pair, 0))) : NULL;
    forget(&pair);
    return route;
}

/* A fault other than a delay has struck: few frames come here. */
static bool ask_strike(FatesObject *self, RouteObject *route, const JudgedFrame *frame, int64_t n, int64_t *held_ns)
{
    static PyObject *name;
    if (name == NULL && (name = PyUnicode_InternFromString("strike")) == NULL)
        return false;
    PyObject *arguments[] = {(PyObject *)self,
                             (PyObject *)route,
                             PyLong_FromLongLong(frame->way),
                             PyLong_FromLongLong(frame->can_id),
                             PyBool_FromLong(frame->extended),
                             PyLong_FromLongLong(n),
                             PyLong_FromLongLong(frame->now),
                             PyLong_FromLongLong(*held_ns)};
    bool well = true;
    for (int place = 2; place < 8; place++)
        well = well && arguments[place] != NULL;
    PyObject *held = well ? PyObject_VectorcallMethod(name, arguments, 8, NULL) : NULL;
    well = held != NULL && integer(held, held_ns);
    forget(&held);
    for (int place = 2; place < 8; place++)
        forget(&arguments[place]);
    return well;
}

static bool delay_frame(FatesObject *self, const RouteObject *route, const JudgedFrame *frame, int64_t n,
                        int64_t *held_ns)
{
    int64_t drawn_ns = *held_ns;
    if (route->queue != NULL)
        *held_ns = release_behind(route->queue, frame->now + drawn_ns) - frame->now;
    if (*held_ns == 0)
        return true;
    self->ways[frame->way].delayed++;
    if (self->log == NULL)
        return true;
    int64_t key = frame->extended ? frame->can_id | EXTENDED_FLAG : frame->can_id;
    int64_t entry[ENTRY_NUMBERS] = {frame->now - self->zero, drawn_ns, route->queue != NULL, 0, key, n,
                                    self->delay_code, self->place + frame->way};
    return note_entry(self->log, entry);
}

/* For how long a frame is held, ns; below zero: it does not go on as it is. False for an error. */
bool fate_of(FatesObject *self, const JudgedFrame *frame, int64_t *held_ns)
{
    *held_ns = 0;
    if (!self->acts)
        return true;
    int64_t n;
    self->ways[frame->way].frames++;
    RouteObject *route = frame->extended ? extended_route(self, frame, &n) : standard_route(self, frame, &n);
    if (route == NULL)
        return false;
    bool well = meet_frame(route, frame->now - self->zero, n, held_ns);
    if (well && is_there(route->struck))
        well = ask_strike(self, route, frame, n, held_ns);
    else if (well)
        well = delay_frame(self, route, frame, n, held_ns);
    Py_DecRef((PyObject *)route);
    return well;
}
