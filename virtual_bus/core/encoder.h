/* The encoder of the simulated drive: where it sees the shaft, and what speed its counts are made into. */
#ifndef CORE_ENCODER_H
#define CORE_ENCODER_H

typedef enum SpeedMethod { SPEED_BY_DIFFERENCE, SPEED_BY_EDGES, SPEED_BY_OBSERVER } SpeedMethod;

enum { ERROR_PARTS = 512 };

/* A periodic error, rad of the shaft, as a cubic in each part of a period. */
typedef struct ErrorTable {
    double cubic[ERROR_PARTS][4];
} ErrorTable;

typedef struct Encoder {
    int active; /* 0: an ideal one, its speed by the difference of counts, and nothing of this counts */
    int distorted; /* it sees the shaft elsewhere than it is */
    int sines;     /* the signals of a line are a sine and a cosine with errors */
    int method; /* SpeedMethod */
    double lines;
    double sine_offset, cosine_offset;  /* of the cosine's amplitude */
    double sine_in_phase, sine_across;  /* its gain times cosine and sine of what it is apart beyond a quarter */
    double eccentricity_rad, eccentricity_phase_rad;
    double delay_share;                           /* of an inner period: the angle told was that one */
    double timer_hz;                              /* of what times the edges; 0: without steps */
    double observer_position_gain, observer_speed_gain; /* 1/s and 1/s^2 */
    int loses; /* counts were lost, or are: the disc is dirty */
    double dirt_from, dirt_width; /* of a turn, counts: where no edge is seen; no width: clean */
    ErrorTable of_line, of_turn;  /* as tabulate_errors made them */
} Encoder;

/* An angle as whole turns and the rest, 0 <= angle_rad < 2 pi. */
typedef struct Place {
    double turns, angle_rad;
} Place;

typedef struct EncoderState {
    Place shaft, seen; /* at the last tick: the shaft's, and where the encoder saw it */
    double shaft_speed_rad_s, seen_speed_rad_s;
    double speed_rad_s;                    /* as made of the counts */
    double edge, edge_s, edges;            /* the last one: its count, its instant since power-on; 0: none yet */
    double observer_ahead, observer_speed; /* counts beyond the encoder's, counts/s */
    double lost;                           /* counts, since power-on */
    double turn, lost_by_turn, missing;    /* the last one begun, with its index pulse; lost until it, and since the one before */
    double dirty;                          /* counts from 0 on that the dirt covers, at the last tick */
    double soiled;                         /* 1: that is known */
} EncoderState;

typedef struct Resolution {
    double counts; /* per turn */
    double counts_per_rad, rad_per_count;
} Resolution;

/* To be called once what they are of is set. */
void tabulate_errors(Encoder *p);

/* Where the encoder sees a shaft that is at `shaft` with that speed. To be called at each tick. */
Place encoder_sees(EncoderState *state, const Encoder *p, Place shaft, double speed_rad_s, double period_s);

/* The count that is left of `count`, where edges go unseen. To be called at each tick. */
double count_seen(EncoderState *state, const Encoder *p, const Resolution *resolution, double count);

/* The speed, rad/s, that the drive makes of the count at this tick and the one before. */
double encoder_speed(EncoderState *state, const Encoder *p, const Resolution *resolution, double count, double before,
                     Place seen, double tick, double period_s);

#endif
