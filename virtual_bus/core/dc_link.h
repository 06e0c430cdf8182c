/* The DC link: a source behind a resistance, its capacitor, a chopper with its resistor, the inverter. */
#ifndef CORE_DC_LINK_H
#define CORE_DC_LINK_H

typedef struct DcLink {
    int active;     /* 0: the link is a source without end, and nothing of this counts */
    int feeds_back; /* the source takes energy back; 0: a rectifier, whose diodes block */
    double source_v, source_siemens;
    double capacitance_f;
    double chopper_siemens; /* 0: none */
    double chopper_on_v, chopper_off_v;
    double idle_w;       /* of logic and gate drivers, also while the inverter is off */
    double circle_share; /* the largest voltage of the motor over the link's */
    double steps, step_s;
} DcLink;

typedef struct LinkState {
    double volts;
    double chopping;              /* 1: the chopper is closed */
    double supplied_j, chopped_j; /* from the source into the link, and from that into the chopper's resistor */
    double asked; /* 1: of the motor is known what its windings store, J, and what it turns into heat and motion, W */
    double stored_j, consumed_w;
} LinkState;

/* One period in which the inverter takes `watts` out of the link on average. */
void advance_link(LinkState *state, const DcLink *p, double watts);

#endif
