/* Frames that come regularly, and surplus frames between two of them. */
#ifndef CORE_REGULAR_STREAM_H
#define CORE_REGULAR_STREAM_H

#include <stdbool.h>
#include <stdint.h>

enum {
    OCTETS_MAX = 8,
    /* Frames of which another one may be a repetition. */
    RECENT = 32,
    /* This many repetitions mark a network that repeats frames. A single one may be an equal answer beside a
       stranger's frame. */
    REPEATS = 2,
    /* Frames over which the usual delay is averaged: a gateway's new one is learnt within ten periods. */
    LEARNT = 8,
    /* More between two regular frames are a flood, which is counted against the SYNCs. */
    EXTRAS_MAX = 16,
    /* A frame that answers a SYNC comes as usual within this part of a period: delays by a busy bus. */
    NOISE_PARTS = 40,
};

typedef struct Octets {
    int length;
    unsigned char data[OCTETS_MAX]; /* 0 beyond the length */
} Octets;

typedef struct StreamFrame {
    int64_t at, delay_ns;
    Octets octets;
    bool repeated; /* equal to one of the recent frames */
} StreamFrame;

typedef struct Stream {
    int64_t step, tolerance; /* between the places of two frames */
    double half_ns, noise_ns; /* of the period of the SYNCs that are answered */
    bool alike;   /* all frames are, so none is a repetition */
    bool same;    /* the regular frame after an extra one must be as the one before */
    bool held;    /* a missing frame may have been held back, and still come */
    bool doubled; /* there was more than one frame where one was due, since this was set back */
    bool begun;   /* there is a `last` */
    int64_t last; /* place of the last regular frame */
    int64_t regular, least; /* frames that came in order; so many of them before an extra one */
    /* Frames too many that may be repetitions of one before; in a network that repeats frames, all that equal one of
       the last. */
    int64_t repetitions;
    double usual_ns; /* delay */
    StreamFrame frame; /* the last regular one */
    Octets recent[RECENT]; /* a ring */
    int recent_first, recent_count;
    StreamFrame extras[EXTRAS_MAX]; /* suspected */
    int extra_count;
} Stream;

typedef struct Surplus {
    StreamFrame frames[EXTRAS_MAX];
    int count;
} Surplus;

void trust_stream(Stream *self, int64_t place);
void take_frame(Stream *self, int64_t place, int64_t delay_ns, const Octets *octets, int64_t at, Surplus *found);
void remember_octets(Stream *self, const Octets *octets);
void pass_frames_over(Stream *self, int64_t place, int64_t delay_ns, const Octets *last, int64_t count);
void end_stream(Stream *self, Surplus *found);
bool is_repeating(const Stream *self);

#endif
