/* Unless asked for something else, every frame is acknowledged and none is corrupted: disturbed frames, error
   counters, bus-off, missing acknowledgement, unplugged nodes and the like are the business of
   servobench.virtual_bus.bus.error_handling, which takes over once any of them is used. A port that sends sees its own frame's
   end through on_sent. Two ports that send the same identifier at the same time are served in the order in which
   they were attached (on a real bus their data would collide).

   The next frame is chosen as soon as the bus is known to become free, and stays open to contest until its start of
   frame: whatever else is queued by then, also at that very instant, takes part in the arbitration. So a frame costs
   one event, and the outcome does not depend on the order of events within an instant. */
#include "segment.h"

#include <assert.h>

#include "device.h"
#include "host_place.h"
#include "objects.h"
#include "wire_bits.h"

/* Time of so many bits, rounded up to the next ns. */
int64_t bits_duration(int64_t bits, int64_t bitrate_bit_s)
{
    return (bits * 1000000000 + bitrate_bit_s - 1) / bitrate_bit_s;
}

void set_bitrate(SegmentObject *self, int64_t bitrate_bit_s)
{
    self->bitrate_bit_s = bitrate_bit_s;
    self->intermission_ns = bits_duration(INTERMISSION_BITS, bitrate_bit_s);
    for (int bits = 0; bits <= LONGEST_FRAME_BITS; bits++)
        self->durations_ns[bits] = bits_duration(bits, bitrate_bit_s);
}

/* ---- the queue of a port ---- */

WireFrame *head_of(PortObject *self)
{
    assert(self->count > 0 && 0 <= self->first && self->first < TRANSMIT_QUEUE_MAX);
    return &self->queue[self->first];
}

/* The frame's reference is the caller's from now on. */
WireFrame take_head(PortObject *self)
{
    WireFrame frame = *head_of(self);
    self->first = (self->first + 1) % TRANSMIT_QUEUE_MAX;
    self->count--;
    return frame;
}

/* Arbitration field of the frame at the head. */
uint64_t key_of(PortObject *self) { return head_of(self)->field >> 4; }

static bool wins(PortObject *one, PortObject *other)
{
    uint64_t key = key_of(one), other_key = key_of(other);
    return key < other_key || (key == other_key && one->rank < other->rank);
}

/* ---- arbitration ---- */

/* Takes a reference of its own. */
static bool let_contend(SegmentObject *self, PortObject *port)
{
    if (self->contender_count == self->contender_room) {
        int room = self->contender_room ? 2 * self->contender_room : 8;
        PortObject **contenders = PyMem_Realloc(self->contenders, (size_t)room * sizeof *contenders);
        if (contenders == NULL) {
            PyErr_NoMemory();
            return false;
        }
        self->contenders = contenders;
        self->contender_room = room;
    }
    Py_IncRef((PyObject *)port);
    self->contenders[self->contender_count++] = port;
    return true;
}

/* The contender that wins the arbitration; its reference is the caller's. */
static PortObject *take_winner(SegmentObject *self)
{
    assert(self->contender_count > 0);
    int best = 0;
    for (int place = 1; place < self->contender_count; place++) {
        if (wins(self->contenders[place], self->contenders[best]))
            best = place;
    }
    PortObject *winner = self->contenders[best];
    self->contenders[best] = self->contenders[--self->contender_count];
    return winner;
}

/* Let a port send the head of its queue as soon as the bus is free. Takes a reference of its own. */
static bool begin(SegmentObject *self, PortObject *port)
{
    const WireFrame *frame = head_of(port);
    int bits = wire_bits(frame->field, frame->data, frame->length);
    assert(0 < bits && bits <= LONGEST_FRAME_BITS);
    int64_t now = self->timeline->now;
    self->start_at = now > self->free_at ? now : self->free_at;
    self->end_at = self->start_at + self->durations_ns[bits];
    Py_IncRef((PyObject *)port);
    self->sender = port;
    return let_happen(self->timeline, self->end_at, END_OF_FRAME, (PyObject *)self);
}

static bool choose_by_handling(SegmentObject *self)
{
    static PyObject *name;
    if (name == NULL && (name = PyUnicode_InternFromString("choose")) == NULL)
        return false;
    PyObject *arguments[] = {self->handling};
    return went_well(PyObject_VectorcallMethod(name, arguments, 1, NULL));
}

/* A port has a frame at the head of its queue. */
static bool contend(SegmentObject *self, PortObject *port)
{
    if (is_there(self->handling))
        return choose_by_handling(self);
    PortObject *sender = self->sender;
    if (sender == NULL && !self->delivering)
        return begin(self, port);
    if (sender == NULL || self->timeline->now > self->start_at || !wins(port, sender))
        return let_contend(self, port);
    /* The frame chosen before has not begun and loses. */
    self->sender = NULL;
    bool well = let_contend(self, sender) && begin(self, port);
    Py_DecRef((PyObject *)sender);
    return well;
}

/* Sets the error of a port that takes no frame: it is full, off or detached. */
static bool refuse(PortObject *self)
{
    static PyObject *name;
    if (name == NULL && (name = PyUnicode_InternFromString("refusal")) == NULL)
        return false;
    PyObject *arguments[] = {(PyObject *)self};
    PyObject *error = PyObject_VectorcallMethod(name, arguments, 1, NULL);
    if (error != NULL) {
        PyErr_SetObject((PyObject *)error->type, error);
        Py_DecRef(error);
    }
    return false;
}

bool send_frame(PortObject *self, const WireFrame *frame)
{
    if (self->count >= self->room || !is_there(self->listener))
        return refuse(self);
    assert(self->count < TRANSMIT_QUEUE_MAX);
    Py_IncRef(frame->object);
    self->queue[(self->first + self->count++) % TRANSMIT_QUEUE_MAX] = *frame;
    return self->count > 1 || contend(self->segment, self);
}

/* ---- the end of a frame ---- */

/* A frame on its way to everybody, and the objects that tell of it, NULL until somebody asks. */
typedef struct Delivery {
    const WireFrame *frame;
    int64_t now;
    PyObject *at, *can_id;
} Delivery;

/* The instant, borrowed. */
static PyObject *instant_of(Delivery *delivery)
{
    if (delivery->at == NULL)
        delivery->at = PyLong_FromLongLong(delivery->now);
    return delivery->at;
}

static bool tell(PyObject *callable, Delivery *delivery)
{
    PyObject *arguments[] = {NULL, delivery->frame->object, instant_of(delivery)};
    return arguments[2] != NULL
           && went_well(PyObject_Vectorcall(callable, arguments + 1, 2 | PY_VECTORCALL_ARGUMENTS_OFFSET, NULL));
}

/* What a dictionary has for the frame's identifier, with a reference; NULL: nothing, or an error. */
static PyObject *entry_for(PyObject *heard, Delivery *delivery)
{
    if (delivery->frame->extended)
        return NULL;
    if (delivery->can_id == NULL && (delivery->can_id = identifier(delivery->frame->can_id)) == NULL)
        return NULL;
    PyObject *entry = PyDict_GetItemWithError(heard, delivery->can_id);
    return entry == NULL ? NULL : another(entry);
}

static bool tell_listener(PyObject *listener, Delivery *delivery)
{
    static PyObject *name;
    if (name == NULL && (name = PyUnicode_InternFromString("on_frame")) == NULL)
        return false;
    PyObject *arguments[] = {another(listener), delivery->frame->object, instant_of(delivery)};
    bool well = arguments[2] != NULL && went_well(PyObject_VectorcallMethod(name, arguments, 3, NULL));
    Py_DecRef(arguments[0]);
    return well;
}

/* To a listener that wants some data frames only. Remote frames are always handed on. */
static bool hand_if_heard(PortObject *port, Delivery *delivery)
{
    PyObject *entry = entry_for(port->heard, delivery);
    if (entry == NULL)
        return !PyErr_Occurred();
    bool well;
    if (port->seat != NULL) {
        PyObject *seat = another((PyObject *)port->seat);
        well = is_a(entry, &PyTuple_Type, "a tuple of handlers")
               && hear_at_seat(port->seat, entry, (FrameObject *)delivery->frame->object, delivery->now);
        Py_DecRef(seat);
    } else {
        well = tell_listener(port->listener, delivery);
    }
    Py_DecRef(entry);
    return well;
}

static bool hand_to(PortObject *port, Delivery *delivery)
{
    PyObject *listener = port->listener;
    if (!is_there(listener))
        return true;
    if (listener->type == place_type)
        return hear_frame((PlaceObject *)listener, delivery->frame, delivery->now);
    if (is_there(port->heard) && !delivery->frame->remote)
        return hand_if_heard(port, delivery);
    return tell_listener(listener, delivery);
}

static bool hand_to_all(PyObject *monitors, PyObject *ports, PortObject *sender, Delivery *delivery)
{
    Py_ssize_t monitor_count = PyTuple_Size(monitors), port_count = PyTuple_Size(ports);
    for (Py_ssize_t place = 0; place < monitor_count; place++) {
        if (!tell(PyTuple_GetItem(monitors, place), delivery))
            return false;
    }
    for (Py_ssize_t place = 0; place < port_count; place++) {
        PortObject *port = (PortObject *)PyTuple_GetItem(ports, place);
        if (port != sender && !hand_to(port, delivery))
            return false;
    }
    if (!is_there(sender->on_sent))
        return true;
    PyObject *on_sent = another(sender->on_sent);
    PlaceObject *place = place_told(on_sent);
    bool well = place != NULL ? keep_frame(place, delivery->frame->object, delivery->now, true)
                              : tell(on_sent, delivery);
    Py_DecRef(on_sent);
    return well;
}

/* To the monitors, to every port but its sender's, and to its sender. */
static bool hand_out(SegmentObject *self, PortObject *sender, const WireFrame *frame, int64_t now)
{
    Delivery delivery = {frame, now, NULL, NULL};
    PyObject *monitors = another(self->monitors), *ports = another(self->ports);
    bool well = hand_to_all(monitors, ports, sender, &delivery);
    Py_DecRef(ports);
    Py_DecRef(monitors);
    forget(&delivery.at);
    forget(&delivery.can_id);
    return well;
}

static bool choose_next(SegmentObject *self)
{
    if (is_there(self->handling))
        return choose_by_handling(self);
    if (self->contender_count == 0)
        return true;
    PortObject *winner = take_winner(self);
    bool well = begin(self, winner);
    Py_DecRef((PyObject *)winner);
    return well;
}

/* The last bit of end of frame has passed: deliver, and choose the next frame, whatever was raised meanwhile. */
bool end_frame(SegmentObject *self, int64_t now)
{
    PortObject *sender = self->sender;
    if (sender == NULL || now != self->end_at)
        return true; /* the end of a frame that lost the arbitration before its start */
    WireFrame frame = take_head(sender);
    self->sender = NULL;
    self->free_at = now + self->intermission_ns;
    self->frames++;
    add_load(&self->load->load, self->free_at - self->start_at, self->free_at);
    bool well = sender->count == 0 || let_contend(self, sender);
    self->delivering = true;
    well = well && hand_out(self, sender, &frame, now);
    self->delivering = false;
    Py_DecRef(frame.object);
    Py_DecRef((PyObject *)sender);
    if (well)
        return choose_next(self);
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    if (choose_next(self)) {
        PyErr_Restore(type, value, traceback);
    } else {
        forget(&type), forget(&value), forget(&traceback);
    }
    return false;
}
