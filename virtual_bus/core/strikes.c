/* Whether a fault strikes a frame, and for how long one holds it. Each draws the same number of times for every frame,
   struck or not, in its window or not, so that none of its draws depends on its own settings or on another fault. */
#include <assert.h>

#include "faults.h"
#include "objects.h"

static bool all_even(const double *numbers, Py_ssize_t count)
{
    bool well = count > 0;
    for (Py_ssize_t place = 0; well && place < count; place++)
        well = 0.0 <= numbers[place] && numbers[place] < 1.0;
    if (!well)
        PyErr_Format(PyExc_ValueError, "%zd random numbers: at least 1, each in [0, 1), expected", count);
    return well;
}

static bool take_block(NumbersObject *self)
{
    PyObject *block = PyObject_Vectorcall(self->refill, NULL, 0, NULL);
    const double *numbers;
    Py_ssize_t count;
    if (block == NULL || !doubles(block, &numbers, &count) || !all_even(numbers, count)) {
        forget(&block);
        return false;
    }
    PyObject *before = self->block;
    self->block = block;
    self->numbers = numbers;
    self->count = count;
    self->next = 0;
    forget(&before);
    return true;
}

bool draw_number(NumbersObject *self, double *drawn)
{
    if (self->next == self->count) {
        Py_IncRef((PyObject *)self); /* whoever draws may lose it meanwhile */
        bool well = take_block(self);
        if (well)
            *drawn = self->numbers[self->next++];
        Py_DecRef((PyObject *)self);
        return well;
    }
    assert(0 <= self->next && self->next < self->count);
    *drawn = self->numbers[self->next++];
    return true;
}

static bool is_open(const Window *window, int64_t elapsed)
{
    return window->begin <= elapsed && elapsed < window->end;
}

/* Each frame by itself, with a second draw for its number. */
static bool strikes_numbered(StrikeObject *self, bool open, bool *struck)
{
    double first;
    if (!draw_number(self->numbers, &first) || !draw_number(self->numbers, &self->value))
        return false;
    *struck = first < self->chances[0] && open;
    return true;
}

/* Gilbert and Elliott's chain of two states. */
static bool strikes_in_bursts(StrikeObject *self, bool open, bool *struck)
{
    double move, lose;
    if (!draw_number(self->numbers, &move) || !draw_number(self->numbers, &lose))
        return false;
    self->bad = self->bad ? move >= self->chances[1] : move < self->chances[0];
    *struck = lose < self->chances[self->bad ? 3 : 2] && open;
    return true;
}

/* By the method of a Python class on top of it; `elapsed` is its argument. */
static PyObject *ask_own(PyObject *self, PyObject **name, const char *text, int64_t elapsed)
{
    if (*name == NULL && (*name = PyUnicode_InternFromString(text)) == NULL)
        return NULL;
    PyObject *arguments[] = {self, PyLong_FromLongLong(elapsed)};
    PyObject *said = arguments[1] == NULL ? NULL : PyObject_VectorcallMethod(*name, arguments, 2, NULL);
    forget(&arguments[1]);
    return said;
}

static bool strikes_own(StrikeObject *self, int64_t elapsed, bool *struck)
{
    static PyObject *name;
    PyObject *said = ask_own((PyObject *)self, &name, "strikes", elapsed);
    int truth = said == NULL ? -1 : PyObject_IsTrue(said);
    forget(&said);
    *struck = truth > 0;
    return truth >= 0;
}

/* Asked once for each frame, `elapsed` ns after the plan's time zero. False for an error. */
bool strikes_frame(StrikeObject *self, int64_t elapsed, bool *struck)
{
    if (self->own_strikes)
        return strikes_own(self, elapsed, struck);
    bool open = is_open(&self->window, elapsed);
    double drawn;
    *struck = false;
    switch (self->shape) {
    case INDEPENDENT:
        if (!draw_number(self->numbers, &drawn))
            return false;
        *struck = drawn < self->chances[0] && open;
        return true;
    case NUMBERED:
        return strikes_numbered(self, open, struck);
    case BURST:
        return strikes_in_bursts(self, open, struck);
    case PERIODIC:
        *struck = open && self->count++ % self->width != 0;
        return true;
    case FIRST:
        *struck = open && self->count > 0;
        self->count -= *struck;
        return true;
    default:
        PyErr_Format(PyExc_NotImplementedError, "strikes");
        return false;
    }
}

/* The first number of the entry for the frame just struck. */
bool number_of_strike(StrikeObject *self, int64_t *number)
{
    static PyObject *name;
    if (!self->own_number) {
        bool numbered = self->shape == NUMBERED;
        *number = numbered ? self->least + (int64_t)(self->value * (double)self->width) : 0;
        return true;
    }
    if (name == NULL && (name = PyUnicode_InternFromString("number")) == NULL)
        return false;
    PyObject *arguments[] = {(PyObject *)self};
    PyObject *said = PyObject_VectorcallMethod(name, arguments, 1, NULL);
    bool well = said != NULL && integer(said, number);
    forget(&said);
    return well;
}

/* Draws a bar of a histogram by its count, then a time within it. */
static bool holds_measured(HoldObject *self, int64_t *held_ns)
{
    double of_bar, within;
    if (!draw_number(self->numbers, &of_bar) || !draw_number(self->numbers, &within))
        return false;
    assert(self->bar_count > 0);
    int64_t place = (int64_t)(of_bar * (double)self->bars[self->bar_count - 1].sum);
    int below = 0, above = self->bar_count - 1; /* the first bar whose sum is above `place`, or the last one */
    while (below < above) {
        int middle = (below + above) / 2;
        if (self->bars[middle].sum > place)
            above = middle;
        else
            below = middle + 1;
    }
    const Bar *bar = &self->bars[below];
    *held_ns = bar->low_ns + (int64_t)(within * (double)bar->width_ns);
    return true;
}

static bool holds_own(HoldObject *self, int64_t elapsed, int64_t *held_ns)
{
    static PyObject *name;
    PyObject *said = ask_own((PyObject *)self, &name, "holds", elapsed);
    bool well = said != NULL && integer(said, held_ns);
    forget(&said);
    return well;
}

/* Asked once for each frame. False for an error. */
bool holds_frame(HoldObject *self, int64_t elapsed, int64_t *held_ns)
{
    if (self->own_holds)
        return holds_own(self, elapsed, held_ns);
    if (self->numbers == NULL) {
        PyErr_Format(PyExc_NotImplementedError, "holds");
        return false;
    }
    if (self->measured) {
        if (!holds_measured(self, held_ns))
            return false;
    } else {
        double drawn;
        if (!draw_number(self->numbers, &drawn))
            return false;
        *held_ns = self->least + (int64_t)(drawn * (double)self->width);
    }
    if (!is_open(&self->window, elapsed))
        *held_ns = 0;
    return true;
}
