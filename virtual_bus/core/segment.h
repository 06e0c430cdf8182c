/* One CAN segment in simulated time: arbitration, exact frame time, frame spacing, load. */
#ifndef CORE_SEGMENT_H
#define CORE_SEGMENT_H

#include "bus_load.h"
#include "timeline.h"

enum {
    /* Frames that a port holds for the bus; one more is refused. A sub-block of an SDO block transfer is sent at
       once, 127 segments (CiA 301, 7.2.4.3), and PDOs go on beside it. */
    TRANSMIT_QUEUE_MAX = 256,
    /* Extended, eight data octets, as many stuff bits as there can be: 118 + 29 + 10. */
    LONGEST_FRAME_BITS = 157,
    INTERMISSION_BITS = 3, /* Bosch CAN 2.0, part B, 3.2.5 */
    DATA_MAX = 8,
};

/* A frame of Python's, and what of it is on the wire. */
typedef struct WireFrame {
    PyObject *object;
    uint64_t field; /* arbitration field, and below it the four bits of the DLC */
    uint32_t can_id;
    bool extended, remote;
    int length;
    unsigned char data[DATA_MAX];
} WireFrame;

typedef struct SegmentObject SegmentObject;

/* A node's connection to a segment: a first-in first-out transmit queue and a listener. */
typedef struct PortObject {
    PyObject head;
    SegmentObject *segment;
    PyObject *name, *listener, *on_sent;
    PyObject *heard; /* the data frames that its listener wants, a dictionary by identifier; None: every frame */
    struct SeatObject *seat; /* takes these by what the dictionary has for them, handlers; NULL: the listener does */
    int64_t rank; /* of two ports that send the same at the same time the lower goes first */
    int room;     /* 0: bus-off, nothing is taken */
    int first, count;
    WireFrame queue[TRANSMIT_QUEUE_MAX];
} PortObject;

struct SegmentObject {
    PyObject head;
    TimelineObject *timeline;
    PyObject *ports, *monitors; /* tuples: who is handed a frame stays the same while it is handed out */
    PyObject *handling;         /* in charge of the arbitration once something may go wrong; else None */
    PortObject **contenders;    /* those that wait, but for the sender */
    int contender_count, contender_room;
    PortObject *sender;
    int64_t bitrate_bit_s, intermission_ns;
    int64_t durations_ns[LONGEST_FRAME_BITS + 1];
    int64_t start_at, end_at, free_at;
    int64_t frames;
    bool delivering;
    LoadObject *load;
};

extern PyTypeObject *segment_type, *port_type;

bool read_frame(PyObject *object, WireFrame *frame);
WireFrame *head_of(PortObject *self);
WireFrame take_head(PortObject *self);
bool send_frame(PortObject *self, const WireFrame *frame);
bool end_frame(SegmentObject *self, int64_t now);
void set_bitrate(SegmentObject *self, int64_t bitrate_bit_s);
int64_t bits_duration(int64_t bits, int64_t bitrate_bit_s);
uint64_t key_of(PortObject *self);

#endif
