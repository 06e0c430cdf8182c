/* Python's RegularStream (native.pyi). */
#include <assert.h>
#include <stddef.h>
#include <string.h>

#include "answers.h"
#include "attributes.h"
#include "frames.h"
#include "types.h"

#define INSTANT_MAX (INT64_MAX / 2)

typedef struct StreamObject {
    PyObject head;
    Stream stream;
    int64_t seen; /* place of the SYNC that the newest frame answers */
    Answer *answers; /* not compared with the SYNCs yet */
    int64_t count, room;
    Start *starts;
} StreamObject;

static StreamObject *object_of(PyObject *self) { return (StreamObject *)self; }

static PyObject *make(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)names;
    int64_t given[6];
    if (!takes(PyTuple_Size(arguments), 6, "RegularStream"))
        return NULL;
    for (int place = 0; place < 6; place++)
        if (!integer(PyTuple_GetItem(arguments, place), &given[place]))
            return NULL;
    for (int place = 0; place < 4; place++)
        if (given[place] < 0 || given[place] > INSTANT_MAX)
            return PyErr_Format(PyExc_ValueError, "argument %d is %lld: a number from 0 on expected", place + 1,
                                (long long)given[place]);
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self == NULL)
        return NULL;
    Stream *stream = &object_of(self)->stream;
    stream->step = given[0];
    stream->tolerance = given[1];
    stream->least = given[2];
    stream->half_ns = (double)given[3] / 2.0;
    stream->noise_ns = (double)given[3] / NOISE_PARTS;
    stream->alike = given[4] != 0;
    stream->same = given[5] != 0;
    stream->held = true;
    return self;
}

static void discard(PyObject *self)
{
    PyMem_Free(object_of(self)->answers);
    PyMem_Free(object_of(self)->starts);
    end_object(self);
}

/* Instants and places whose differences are numbers of 64 bits. */
static bool near_integer(PyObject *object, int64_t *value)
{
    if (!integer(object, value))
        return false;
    bool fits = -INSTANT_MAX <= *value && *value <= INSTANT_MAX;
    if (!fits)
        PyErr_Format(PyExc_ValueError, "%lld: a number of at most 62 bits expected", (long long)*value);
    return fits;
}

static bool read_octets(PyObject *data, Octets *octets)
{
    char *given;
    Py_ssize_t length;
    if (PyBytes_AsStringAndSize(data, &given, &length) < 0)
        return false;
    if (length > OCTETS_MAX) {
        PyErr_Format(PyExc_ValueError, "%zd octets in a frame: at most %d expected", length, OCTETS_MAX);
        return false;
    }
    memset(octets, 0, sizeof *octets);
    octets->length = (int)length;
    memcpy(octets->data, given, (size_t)length);
    return true;
}

/* ---- what was found, as pairs of instant and data ---- */

static bool add_pair(PyObject *pairs, const StreamFrame *frame)
{
    PyObject *pair = PyTuple_New(2);
    if (pair == NULL)
        return false;
    PyObject *at = PyLong_FromLongLong(frame->at);
    PyObject *data = PyBytes_FromStringAndSize((const char *)frame->octets.data, frame->octets.length);
    PyTuple_SetItem(pair, 0, at);
    PyTuple_SetItem(pair, 1, data);
    bool well = at != NULL && data != NULL && PyList_Append(pairs, pair) == 0;
    Py_DecRef(pair);
    return well;
}

static bool add_pairs(PyObject *pairs, const Surplus *found)
{
    for (int place = 0; place < found->count; place++)
        if (!add_pair(pairs, &found->frames[place]))
            return false;
    return true;
}

static PyObject *pairs_of(const Surplus *found)
{
    PyObject *pairs = PyList_New(0);
    if (pairs == NULL || add_pairs(pairs, found))
        return pairs;
    Py_DecRef(pairs);
    return NULL;
}

/* ---- SYNCs and frames ---- */

/* An attribute of a SyncMark; `is_none`: it is None. */
static bool read_mark(PyObject *mark, Attribute *which, int64_t *value, bool *is_none)
{
    PyObject *read = attribute(which, mark);
    if (read == NULL)
        return false;
    *is_none = read == Py_None;
    bool well = *is_none || near_integer(read, value);
    Py_DecRef(read);
    return well;
}

static bool read_start(PyObject *mark, Start *start)
{
    static Attribute place = {.spelt = "place"}, on_bus_at = {.spelt = "on_bus_at"},
                     handed_at = {.spelt = "handed_at"};
    bool is_none, is_unknown;
    return read_mark(mark, &place, &start->place, &is_none) && !is_none
           && read_mark(mark, &on_bus_at, &start->at, &is_unknown)
           && (!is_unknown || (read_mark(mark, &handed_at, &start->at, &is_none) && !is_none));
}

/* The SYNCs before `until`, and the last that a frame answered: into the end of `told`. How many, or -1. */
static int read_starts(PyObject *marks, int64_t seen, int64_t until, Start *told)
{
    int count = 0;
    for (Py_ssize_t left = PyList_Size(marks); left > 0 && count < SYNCS_MAX; left--) {
        Start *start = &told[SYNCS_MAX - 1 - count];
        PyObject *mark = left <= PyList_Size(marks) ? PyList_GetItem(marks, left - 1) : NULL;
        if (mark == NULL)
            return PyErr_Occurred() ? -1 : count;
        mark = another(mark);
        bool well = read_start(mark, start);
        Py_DecRef(mark);
        if (!well) {
            if (!PyErr_Occurred())
                PyErr_Format(PyExc_ValueError, "a SYNC without a place or an instant");
            return -1;
        }
        if (start->place < seen)
            break;
        count += start->at < until;
    }
    return count;
}

static bool add_answer(StreamObject *self, const Answer *answer)
{
    if (self->count == self->room) {
        int64_t room = self->room ? 2 * self->room : SYNCS_MAX;
        Answer *answers = PyMem_Realloc(self->answers, (size_t)room * sizeof *answers);
        if (answers == NULL) {
            PyErr_NoMemory();
            return false;
        }
        self->answers = answers;
        self->room = room;
    }
    assert(0 <= self->count && self->count < self->room);
    self->answers[self->count++] = *answer;
    return true;
}

static bool read_answer(const char *row, Answer *answer)
{
    KeptFrame frame;
    memcpy(&frame, row, sizeof frame);
    bool fits = -INSTANT_MAX <= frame.at && frame.at <= INSTANT_MAX && 0 <= frame.length && frame.length <= OCTETS_MAX;
    if (!fits)
        PyErr_Format(PyExc_ValueError, "a frame of %lld octets at %lld: at most %d and 62 bits expected",
                     (long long)frame.length, (long long)frame.at, OCTETS_MAX);
    answer->at = frame.at;
    answer->octets.length = (int)frame.length;
    memcpy(answer->octets.data, frame.data, sizeof frame.data);
    return fits;
}

/* Put frames, in rows, behind those that wait. */
static bool read_answers(StreamObject *self, PyObject *frames)
{
    char *rows;
    Py_ssize_t octets, row = (Py_ssize_t)sizeof(KeptFrame);
    if (PyBytes_AsStringAndSize(frames, &rows, &octets) < 0)
        return false;
    if (octets % row != 0) {
        PyErr_Format(PyExc_ValueError, "%zd octets: rows of %zd expected", octets, row);
        return false;
    }
    Answer answer;
    for (Py_ssize_t place = 0; place < octets; place += row)
        if (!read_answer(rows + place, &answer) || !add_answer(self, &answer))
            return false;
    return true;
}

/* Keep the answers from `until` on for the next time, as many as there are SYNCs; in front those before it, whose
   number is given. */
static int64_t part_answers(StreamObject *self, int64_t until, Answer **before)
{
    int64_t count = 0, later = 0;
    for (int64_t place = 0; place < self->count; place++)
        later += self->answers[place].at >= until;
    *before = PyMem_Realloc(NULL, (size_t)(self->count - later + 1) * sizeof **before);
    if (*before == NULL)
        return -1;
    int64_t dropped = later > SYNCS_MAX ? later - SYNCS_MAX : 0, kept = 0;
    for (int64_t place = 0; place < self->count; place++) {
        Answer answer = self->answers[place];
        if (answer.at < until)
            (*before)[count++] = answer;
        else if (dropped > 0)
            dropped--;
        else
            self->answers[kept++] = answer;
    }
    self->count = kept;
    return count;
}

/* Each answer is that to the last SYNC before it. */
static bool take_answers(StreamObject *self, const Start *starts, int count, const Answer *answers, int64_t came,
                         PyObject *pairs)
{
    Surplus found;
    int place = 0;
    if (pass_answers(&self->stream, &self->seen, starts, count, answers, came))
        return true;
    for (int64_t number = 0; count > 0 && number < came; number++) {
        const Answer *answer = &answers[number];
        while (place + 1 < count && starts[place + 1].at <= answer->at)
            place++;
        if (starts[place].at > answer->at)
            continue;
        self->seen = starts[place].place;
        take_frame(&self->stream, self->seen, answer->at - starts[place].at, &answer->octets, answer->at, &found);
        if (!add_pairs(pairs, &found))
            return false;
    }
    return true;
}

static PyObject *found_among(StreamObject *self, PyObject *marks, int64_t until, const Answer *answers, int64_t came)
{
    Start told[SYNCS_MAX];
    int count = read_starts(marks, self->seen, until, told);
    if (count < 0)
        return NULL;
    if (self->starts == NULL
        && (self->starts = PyMem_Realloc(NULL, STARTS_MAX * sizeof *self->starts)) == NULL)
        return PyErr_NoMemory();
    int filled = fill_missing(&told[SYNCS_MAX - count], count, self->starts);
    PyObject *pairs = PyList_New(0);
    if (pairs == NULL || take_answers(self, self->starts, filled, answers, came, pairs))
        return pairs;
    Py_DecRef(pairs);
    return NULL;
}

/* Arguments frames, marks, until. */
static PyObject *call_compare(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t until;
    Answer *answers;
    if (!takes(count, 3, "compare") || !is_a(arguments[0], &PyBytes_Type, "octets")
        || !is_a(arguments[1], &PyList_Type, "a list") || !integer(arguments[2], &until)
        || !read_answers(object_of(self), arguments[0]))
        return NULL;
    int64_t came = part_answers(object_of(self), until, &answers);
    if (came < 0)
        return PyErr_NoMemory();
    PyObject *pairs = found_among(object_of(self), arguments[1], until, answers, came);
    PyMem_Free(answers);
    PyObject *result = pairs == NULL ? NULL : PyTuple_New(2);
    if (result == NULL) {
        forget(&pairs);
        return NULL;
    }
    PyTuple_SetItem(result, 0, pairs);
    PyTuple_SetItem(result, 1, PyLong_FromLongLong(came));
    return result;
}

static PyObject *call_trust(PyObject *self, PyObject *place)
{
    int64_t value;
    if (!near_integer(place, &value))
        return NULL;
    trust_stream(&object_of(self)->stream, value);
    return nothing();
}

/* Arguments place, delay, data, at. */
static PyObject *call_take(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    int64_t place, delay_ns, at;
    Octets octets;
    Surplus found;
    if (!takes(count, 4, "take") || !near_integer(arguments[0], &place) || !near_integer(arguments[1], &delay_ns)
        || !read_octets(arguments[2], &octets) || !near_integer(arguments[3], &at))
        return NULL;
    take_frame(&object_of(self)->stream, place, delay_ns, &octets, at, &found);
    return pairs_of(&found);
}

static PyObject *call_end(PyObject *self, PyObject *none)
{
    (void)none;
    Surplus found;
    end_stream(&object_of(self)->stream, &found);
    return pairs_of(&found);
}

static PyMethodDef methods[] = {
    {"trust", call_trust, METH_O, NULL},
    {"take", (PyCFunction)(void (*)(void))call_take, METH_FASTCALL, NULL},
    {"compare", (PyCFunction)(void (*)(void))call_compare, METH_FASTCALL, NULL},
    {"end", call_end, METH_NOARGS, NULL},
    {0},
};

static PyMemberDef members[] = {
    {"seen", T_LONGLONG, offsetof(StreamObject, seen), 0, NULL},
    {"least", T_LONGLONG, offsetof(StreamObject, stream.least), 0, NULL},
    {"held", T_BOOL, offsetof(StreamObject, stream.held), 0, NULL},
    {"doubled", T_BOOL, offsetof(StreamObject, stream.doubled), 0, NULL},
    {"repetitions", T_LONGLONG, offsetof(StreamObject, stream.repetitions), READONLY, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)make},
    {Py_tp_dealloc, (void *)discard},
    {Py_tp_methods, methods},
    {Py_tp_members, members},
    {0},
};

PyType_Spec regular_stream_spec = {
    .name = "servobench.hil.core.native.RegularStream",
    .basicsize = sizeof(StreamObject),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = slots,
};
