/* Python's UniformNumbers, Strike and Hold (native.pyi). */
#include <stddef.h>

#include "faults.h"
#include "objects.h"
#include "types.h"

PyTypeObject *numbers_type, *strike_type, *hold_type;

/* Beyond it a sum of a few would no longer fit. */
static const int64_t NUMBER_MAX = (int64_t)1 << 60;

static NumbersObject *numbers_of(PyObject *self) { return (NumbersObject *)self; }

static StrikeObject *strike_of(PyObject *self) { return (StrikeObject *)self; }

static HoldObject *hold_of(PyObject *self) { return (HoldObject *)self; }

/* ---- UniformNumbers ---- */

static PyObject *make_numbers(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, 1, 1, "UniformNumbers"))
        return NULL;
    PyObject *self = PyType_GenericAlloc(type, 0);
    if (self != NULL)
        numbers_of(self)->refill = another(PyTuple_GetItem(arguments, 0));
    return self;
}

static int visit_numbers(PyObject *self, visitproc visit, void *argument)
{
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_one(numbers_of(self)->refill, visit, argument);
}

/* No clear: it is never without what makes the next block. */
static void discard_numbers(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    forget(&numbers_of(self)->refill);
    forget(&numbers_of(self)->block);
    end_object(self);
}

static PyObject *call_draw(PyObject *self, PyObject *none)
{
    (void)none;
    double drawn;
    return draw_number(numbers_of(self), &drawn) ? PyFloat_FromDouble(drawn) : NULL;
}

static PyMethodDef numbers_methods[] = {
    {"draw", call_draw, METH_NOARGS, NULL},
    {0},
};

static PyType_Slot numbers_slots[] = {
    {Py_tp_new, (void *)make_numbers},
    {Py_tp_traverse, (void *)visit_numbers},
    {Py_tp_dealloc, (void *)discard_numbers},
    {Py_tp_methods, numbers_methods},
    {0},
};

PyType_Spec numbers_spec = {
    .name = "servobench.virtual_bus.core.native.UniformNumbers",
    .basicsize = sizeof(NumbersObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    .slots = numbers_slots,
};

/* ---- arguments that both have ---- */

static bool read_window(PyObject *object, Window *window)
{
    PyObject *pair = PySequence_Tuple(object);
    bool well = pair != NULL && takes(PyTuple_Size(pair), 2, "a window")
                && integer(PyTuple_GetItem(pair, 0), &window->begin)
                && integer(PyTuple_GetItem(pair, 1), &window->end);
    forget(&pair);
    return well;
}

static bool read_number(PyObject *object, int64_t least, int64_t *value)
{
    if (!integer(object, value))
        return false;
    if (least <= *value && *value <= NUMBER_MAX)
        return true;
    PyErr_Format(PyExc_ValueError, "%lld: %lld to 2^60 expected", (long long)*value, (long long)least);
    return false;
}

static bool take_numbers(PyObject *object, NumbersObject **place)
{
    if (!is_a(object, numbers_type, "UniformNumbers"))
        return false;
    PyObject *before = (PyObject *)*place;
    *place = (NumbersObject *)another(object);
    forget(&before);
    return true;
}

/* ---- Strike ---- */

/* Arguments are those of a Python class on top of it. */
static PyObject *make_strike(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)arguments, (void)names;
    int own_strikes = is_overridden(type, strike_type, "strikes");
    int own_number = is_overridden(type, strike_type, "number");
    PyObject *self = own_strikes < 0 || own_number < 0 ? NULL : PyType_GenericAlloc(type, 0);
    if (self != NULL) {
        strike_of(self)->own_strikes = own_strikes > 0;
        strike_of(self)->own_number = own_number > 0;
        strike_of(self)->kind = PyUnicode_FromString("");
        if (strike_of(self)->kind == NULL)
            forget(&self);
    }
    return self;
}

static int set_strike(PyObject *self, PyObject *arguments, PyObject *names)
{
    StrikeObject *strike = strike_of(self);
    if (!takes_between(arguments, names, 2, 2, "Strike") || !read_window(PyTuple_GetItem(arguments, 1), &strike->window))
        return -1;
    PyObject *before = strike->kind;
    strike->kind = another(PyTuple_GetItem(arguments, 0));
    forget(&before);
    return 0;
}

static int visit_strike(PyObject *self, visitproc visit, void *argument)
{
    int result = visit((PyObject *)self->type, argument);
    if (!result)
        result = visit_one(strike_of(self)->kind, visit, argument);
    return result ? result : visit_one((PyObject *)strike_of(self)->numbers, visit, argument);
}

static int clear_strike(PyObject *self)
{
    strike_of(self)->shape = NO_STRIKE;
    forget((PyObject **)&strike_of(self)->numbers);
    return 0;
}

static void discard_strike(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    clear_strike(self);
    forget(&strike_of(self)->kind);
    end_object(self);
}

/* by_chance(shape, numbers, *chances) */
static PyObject *call_by_chance(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    StrikeObject *strike = strike_of(self);
    int64_t shape;
    if (count < 3 || count > 2 + CHANCES_MAX)
        return PyErr_Format(PyExc_TypeError, "by_chance() takes 3 to %d arguments, %zd were given", 2 + CHANCES_MAX,
                            count);
    if (!integer(arguments[0], &shape) || !take_numbers(arguments[1], &strike->numbers)
        || !numbers(arguments + 2, strike->chances, (int)count - 2))
        return NULL;
    if (shape != INDEPENDENT && shape != NUMBERED && shape != BURST)
        return PyErr_Format(PyExc_ValueError, "shape %lld: one that draws expected", (long long)shape);
    strike->shape = (StrikeShape)shape;
    return nothing();
}

/* numbered(least, width) */
static PyObject *call_numbered(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    StrikeObject *strike = strike_of(self);
    if (!takes(count, 2, "numbered") || !read_number(arguments[0], -1, &strike->least)
        || !read_number(arguments[1], 0, &strike->width))
        return NULL;
    return nothing();
}

/* by_count(shape, count) */
static PyObject *call_by_count(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    StrikeObject *strike = strike_of(self);
    int64_t shape, number;
    if (!takes(count, 2, "by_count") || !integer(arguments[0], &shape) || !integer(arguments[1], &number))
        return NULL;
    if ((shape != PERIODIC && shape != FIRST) || number < 1)
        return PyErr_Format(PyExc_ValueError, "shape %lld, %lld: one that counts, and at least 1, expected",
                            (long long)shape, (long long)number);
    strike->shape = (StrikeShape)shape;
    strike->width = number;
    strike->count = shape == FIRST ? number : 0;
    return nothing();
}

static PyObject *call_strikes(PyObject *self, PyObject *argument)
{
    int64_t elapsed;
    bool struck;
    StrikeObject *strike = strike_of(self);
    bool own = strike->own_strikes; /* this is the original that it calls */
    if (!integer(argument, &elapsed))
        return NULL;
    strike->own_strikes = false;
    bool well = strikes_frame(strike, elapsed, &struck);
    strike->own_strikes = own;
    return well ? PyBool_FromLong(struck) : NULL;
}

static PyObject *call_number(PyObject *self, PyObject *none)
{
    (void)none;
    int64_t number;
    StrikeObject *strike = strike_of(self);
    bool own = strike->own_number;
    strike->own_number = false;
    bool well = number_of_strike(strike, &number);
    strike->own_number = own;
    return well ? PyLong_FromLongLong(number) : NULL;
}

static PyMethodDef strike_methods[] = {
    {"by_chance", (PyCFunction)(void (*)(void))call_by_chance, METH_FASTCALL, NULL},
    {"numbered", (PyCFunction)(void (*)(void))call_numbered, METH_FASTCALL, NULL},
    {"by_count", (PyCFunction)(void (*)(void))call_by_count, METH_FASTCALL, NULL},
    {"strikes", call_strikes, METH_O, NULL},
    {"number", call_number, METH_NOARGS, NULL},
    {0},
};

static PyMemberDef strike_members[] = {
    {"kind", T_OBJECT, offsetof(StrikeObject, kind), READONLY, NULL},
    {"begin", T_LONGLONG, offsetof(StrikeObject, window.begin), READONLY, NULL},
    {"end", T_LONGLONG, offsetof(StrikeObject, window.end), READONLY, NULL},
    {"value", T_DOUBLE, offsetof(StrikeObject, value), READONLY, NULL},
    {0},
};

static PyType_Slot strike_slots[] = {
    {Py_tp_new, (void *)make_strike},
    {Py_tp_init, (void *)set_strike},
    {Py_tp_traverse, (void *)visit_strike},
    {Py_tp_clear, (void *)clear_strike},
    {Py_tp_dealloc, (void *)discard_strike},
    {Py_tp_methods, strike_methods},
    {Py_tp_members, strike_members},
    {0},
};

PyType_Spec strike_spec = {
    .name = "servobench.virtual_bus.core.native.Strike",
    .basicsize = sizeof(StrikeObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    .slots = strike_slots,
};

/* ---- Hold ---- */

static PyObject *make_hold(PyTypeObject *type, PyObject *arguments, PyObject *names)
{
    (void)arguments, (void)names;
    int own_holds = is_overridden(type, hold_type, "holds");
    PyObject *self = own_holds < 0 ? NULL : PyType_GenericAlloc(type, 0);
    if (self != NULL)
        hold_of(self)->own_holds = own_holds > 0;
    return self;
}

static int set_hold(PyObject *self, PyObject *arguments, PyObject *names)
{
    if (!takes_between(arguments, names, 2, 2, "Hold")
        || !read_window(PyTuple_GetItem(arguments, 0), &hold_of(self)->window))
        return -1;
    int in_order = PyObject_IsTrue(PyTuple_GetItem(arguments, 1));
    hold_of(self)->in_order = in_order > 0;
    return in_order < 0 ? -1 : 0;
}

static int visit_hold(PyObject *self, visitproc visit, void *argument)
{
    int result = visit((PyObject *)self->type, argument);
    return result ? result : visit_one((PyObject *)hold_of(self)->numbers, visit, argument);
}

static int clear_hold(PyObject *self)
{
    forget((PyObject **)&hold_of(self)->numbers);
    return 0;
}

static void discard_hold(PyObject *self)
{
    PyObject_GC_UnTrack(self);
    clear_hold(self);
    PyMem_Free(hold_of(self)->bars);
    end_object(self);
}

/* uniform(numbers, least, width) */
static PyObject *call_uniform(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    HoldObject *hold = hold_of(self);
    if (!takes(count, 3, "uniform") || !read_number(arguments[1], 0, &hold->least)
        || !read_number(arguments[2], 0, &hold->width) || !take_numbers(arguments[0], &hold->numbers))
        return NULL;
    hold->measured = false;
    return nothing();
}

static bool read_bars(PyObject *edges, PyObject *counts, Bar *bars, Py_ssize_t count)
{
    int64_t sum = 0, low_ns, high_ns, times;
    for (Py_ssize_t place = 0; place < count; place++) {
        if (!read_number(PyTuple_GetItem(edges, place), 0, &low_ns)
            || !read_number(PyTuple_GetItem(edges, place + 1), 0, &high_ns)
            || !read_number(PyTuple_GetItem(counts, place), 0, &times))
            return false;
        sum += times;
        if (high_ns < low_ns || sum > NUMBER_MAX) {
            PyErr_Format(PyExc_ValueError, "bar %zd: rising edges, and at most 2^60 counted, expected", place);
            return false;
        }
        bars[place] = (Bar){low_ns, high_ns - low_ns, sum};
    }
    return true;
}

/* measured(numbers, edges_ns, counts) */
static PyObject *call_measured(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    HoldObject *hold = hold_of(self);
    if (!takes(count, 3, "measured"))
        return NULL;
    PyObject *edges = PySequence_Tuple(arguments[1]);
    PyObject *counts = edges == NULL ? NULL : PySequence_Tuple(arguments[2]);
    Py_ssize_t bars = counts == NULL ? 0 : PyTuple_Size(counts);
    bool well = counts != NULL && bars > 0 && bars < 1 << 20 && PyTuple_Size(edges) == bars + 1;
    if (counts != NULL && !well)
        PyErr_Format(PyExc_ValueError, "%zd bars: 1 to 2^20, and an edge more than bars, expected", bars);
    Bar *made = well ? PyMem_Realloc(NULL, (size_t)bars * sizeof *made) : NULL;
    if (well && made == NULL)
        PyErr_NoMemory();
    well = made != NULL && read_bars(edges, counts, made, bars) && take_numbers(arguments[0], &hold->numbers);
    forget(&edges);
    forget(&counts);
    if (!well) {
        PyMem_Free(made);
        return NULL;
    }
    PyMem_Free(hold->bars);
    hold->bars = made;
    hold->bar_count = (int)bars;
    hold->measured = true;
    return nothing();
}

static PyObject *call_holds(PyObject *self, PyObject *argument)
{
    int64_t elapsed, held_ns;
    HoldObject *hold = hold_of(self);
    bool own = hold->own_holds;
    if (!integer(argument, &elapsed))
        return NULL;
    hold->own_holds = false;
    bool well = holds_frame(hold, elapsed, &held_ns);
    hold->own_holds = own;
    return well ? PyLong_FromLongLong(held_ns) : NULL;
}

static PyMethodDef hold_methods[] = {
    {"uniform", (PyCFunction)(void (*)(void))call_uniform, METH_FASTCALL, NULL},
    {"measured", (PyCFunction)(void (*)(void))call_measured, METH_FASTCALL, NULL},
    {"holds", call_holds, METH_O, NULL},
    {0},
};

static PyMemberDef hold_members[] = {
    {"in_order", T_BOOL, offsetof(HoldObject, in_order), READONLY, NULL},
    {"begin", T_LONGLONG, offsetof(HoldObject, window.begin), READONLY, NULL},
    {"end", T_LONGLONG, offsetof(HoldObject, window.end), READONLY, NULL},
    {0},
};

static PyType_Slot hold_slots[] = {
    {Py_tp_new, (void *)make_hold},
    {Py_tp_init, (void *)set_hold},
    {Py_tp_traverse, (void *)visit_hold},
    {Py_tp_clear, (void *)clear_hold},
    {Py_tp_dealloc, (void *)discard_hold},
    {Py_tp_methods, hold_methods},
    {Py_tp_members, hold_members},
    {0},
};

PyType_Spec hold_spec = {
    .name = "servobench.virtual_bus.core.native.Hold",
    .basicsize = sizeof(HoldObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC,
    .slots = hold_slots,
};
