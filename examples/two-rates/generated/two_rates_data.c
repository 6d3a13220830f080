/* The parameters' values. A sample of what Embedded Coder makes. */
#include "two_rates.h"

/* Block parameters (default storage) */
P_two_rates_T two_rates_P = {
    /* Variable: Kp */
    2.5,
    /* Variable: Ki */
    0.5,
    /* Variable: Limit */
    1.0E+1,
    /* Variable: Weights */
    { 0.25, -0.25 },
    /* Variable: Integral */
    1
};
