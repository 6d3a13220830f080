/* What Linux's simulated radios (mac80211_hwsim) send, and what they hear: the driver hands over each frame to who
 * registers, and who carries it says who hears it when, and how it went. A process registers once. */
#pragma once

#include "channel.h"

/* All return 0 or a number of errno.h. ENODEV: the module is not loaded. */
int hwsim_open(void);
int hwsim_register(void);
/* A further radio, with the address of its interface. */
int hwsim_new_radio(const uint8_t address[ADDRESS]);

/* To be waited for: something is to be read. */
int hwsim_socket(void);

/* Each frame that was sent; `take` frees it. */
void hwsim_read(void (*take)(struct frame *frame));

/* The radio of this address (that of the module, or of hwsim_new_radio) hears a frame. */
void hwsim_deliver(const struct frame *frame, const uint8_t address[ADDRESS], unsigned rate);

/* The radio that sent a frame learns how it went, after so many attempts as the frame says. */
void hwsim_report(const struct frame *frame, bool acknowledged);
