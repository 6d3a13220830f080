/* The program's side of a block's slower rates. */
#ifndef FLOTILLA_EXECUTIVE_RATES_H
#define FLOTILLA_EXECUTIVE_RATES_H

#include <flotilla/rates.h>
#include <stdio.h>

/* Slower rates run below the threads of interrupts that serve serial ports, CAN and the network: the least priority of
 * these in /etc/flotilla/irq-priorities. A rate computes for tens of ms, and a UART holds what comes in one. */
enum { RATES_BELOW = 60 };

/* The priority of a rate by its place, where drivers have `drivers`. 0: ordinary; negative: there is none left. */
int rates_priority(int drivers, uint32_t place);

/* Bring the threads of a block's rates to the processor of the calling thread, which must stay there. 0 or an errno.
 * Nothing happens where there are none. */
int rates_gather(const struct fl_block *block);

/* Let each run of a rate end before fl_rates_release returns. */
void rates_in_turn(const struct fl_block *block);

/* Whether a rate was released, and has not ended since. */
bool rates_run(const struct fl_block *block, uint32_t rate);

/* Take their real-time priorities from the rates: no step follows, and one that hangs must not keep the processor. */
void rates_relax(const struct fl_block *block);

/* As a member of a JSON object, with a comma before it; nothing where there are no rates. After fl_rates_stop. */
void rates_write(const struct fl_block *block, FILE *out);

#endif
