/* What each cycle asks of a CANopen device: frames heard, what a SYNC or a change does to PDOs, frames to send. */
#ifndef CORE_DEVICE_H
#define CORE_DEVICE_H

#include "frames.h"
#include "inner_loops.h"
#include "pdo_codec.h"
#include "segment.h"

enum {
    SYNCHRONOUS_ACYCLIC = 0, /* transmission types (CiA 301, 7.5.2.37) */
    SYNCHRONOUS_CYCLIC_MAX = 240,
    REMOTE_SYNCHRONOUS = 252,
    LOOK_NS = 1000000,  /* a mapped value that changes by itself is looked at no later than that after the last look */
    MILLISECOND_NS = 1000000, /* the period of profiles and position loop; rest is seen within it */
};

/* servobench.drivers.timebase.NEVER */
static const int64_t never_ns = ((int64_t)1 << 62) - 1;

typedef struct DeviceObject DeviceObject;
typedef struct DriveObject DriveObject;
typedef struct SeatObject SeatObject;

/* One deadline of a device; `due` is NEVER while it is stopped. */
typedef struct TimerObject {
    PyObject head;
    DeviceObject *device;
    PyObject *callback;
    int64_t due;
} TimerObject;

/* One TPDO's turn at a SYNC or a change; Python keeps its parameters and timers. */
typedef struct TpdoObject {
    PyObject head;
    DeviceObject *device;
    CodecObject *sample, *watch; /* what it maps; those of it whose change is an event */
    PyObject *on_event;          /* a callable that gets the instant: an event of types 254 and 255 */
    PyObject *latched;           /* octets of the last sample */
    int64_t can_id;
    int type;
    int64_t left, start_at; /* SYNCs until it is sent; the counter at which it begins, or 0 */
    bool follows_sync;
    bool event; /* something is to be sent: at the next SYNC, or when the inhibit time is over */
    bool runs;  /* what it maps changes by time or motion, not only when the device does something */
} TpdoObject;

/* One RPDO's reception; Python judges wrong lengths and keeps the deadline. */
typedef struct RpdoObject {
    PyObject head;
    DeviceObject *device;
    CodecObject *codec;
    PyObject *judge_length;     /* gets a length that is not expected, or follows one */
    TimerObject *deadline;      /* runs from the last reception */
    PyObject *deadline_met;     /* at a reception after one that was missed */
    PyObject *waiting;          /* octets of a synchronous one since the last SYNC; NULL: none */
    int64_t length, deadline_ns; /* deadline_ns 0: there is none */
    int wrong_length; /* the emergency in force, or 0 */
    bool missed, synchronous, window_open;
} RpdoObject;

/* The device's own clock (1013h). */
typedef struct DeviceClockObject {
    PyObject head;
    DeviceObject *device;
    PyObject *tick_after; /* of the inner loops, where stamps are latched at their ticks; else None */
    int64_t first_ns, offset_ns, drift_ppb, started_at, sync_at;
    int64_t unit_ns, resolution_ns, late_ns, written, wrap;
    bool runs, at_arrival;
} DeviceClockObject;

/* What a SYNC is checked for, and what it sets off. */
typedef struct SyncObject {
    PyObject head;
    DeviceObject *device;
    DeviceClockObject *clock;
    PyObject *judge_length; /* gets a length that is not expected, or follows one */
    PyObject *open_window;  /* gets the instant; None: 1007h is 0 */
    PyObject *hold;         /* gets counter and instant of a SYNC that is acted on later; None: at once */
    int length;             /* 1: with a counter (1019h) */
    bool wrong_length;
} SyncObject;

struct DeviceObject {
    PyObject head;
    PyObject *application;
    DriveObject *drive;                     /* the application's, or NULL */
    PyObject *transmit, *receive, *watching; /* a tuple of TPDOs and one of RPDOs; a list of TPDOs sent on a change */
    PyObject *timers;                       /* a list */
    PyObject **out;                         /* frames to send */
    int out_count, out_room;
    int64_t now, next_timer, look_at;
    bool booting, mute, operational, takes_syncs;
};

/* A drive's application: its inner loops, and the statusword that they and the state machine make up. */
struct DriveObject {
    PyObject head;
    PyObject *loops;      /* an InnerLoopsObject */
    PyObject *statusword; /* a Variable */
    PyObject *run_mode;   /* gets the instant while `tasked`; whether the mode is followed still */
    PyObject *stop_on;    /* while `stopping`, after the loops went on */
    PyObject *tell_protection;
    PyObject *shown; /* the last statusword as an object */
    int64_t shown_status, base_status, wake_at, wake_ns;
    bool tasked, stopping, protects, awaits_sync;
};

/* A device's place on a segment in simulated time. */
struct SeatObject {
    PyObject head;
    DeviceObject *device; /* NULL: one that is asked through Python */
    PortObject *port;
    PyObject *failure, *wake;
    int64_t scheduled, frames_lost;
};

extern PyTypeObject *device_type, *drive_type, *tpdo_type, *rpdo_type, *sync_type, *timer_type;
extern PyTypeObject *device_clock_type, *seat_type;

bool advance_application(DeviceObject *self, int64_t now);
bool advance_drive(DriveObject *self, int64_t now);
bool hear_by_device(DeviceObject *self, PyObject *handlers, FrameObject *frame, int64_t now);
bool look_for_changes(DeviceObject *self);
bool sync_device(DeviceObject *self, int64_t counter);
void start_timer(TimerObject *self, int64_t due);
bool run_timers(DeviceObject *self, int64_t now);
bool queue_frame(DeviceObject *self, PyObject *frame);
int64_t due_of_device(DeviceObject *self, bool *well);
bool is_watching(const DeviceObject *self);
bool tpdo_at_sync(TpdoObject *self, int64_t counter);
bool look_at_tpdo(TpdoObject *self);
bool take_rpdo(RpdoObject *self, const FrameObject *frame, int64_t now);
bool actuate_rpdo(RpdoObject *self);
bool take_sync(SyncObject *self, const FrameObject *frame, int64_t now);
bool tell_stamp(DeviceClockObject *self, int64_t *stamp);
bool hear_at_seat(SeatObject *self, PyObject *handlers, FrameObject *frame, int64_t now);

#endif
