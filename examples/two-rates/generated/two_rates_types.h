/* Names of the model's structures. A sample of what Embedded Coder makes. */
#ifndef TWO_RATES_TYPES_H
#define TWO_RATES_TYPES_H
#include "rtwtypes.h"

typedef struct P_two_rates_T_ P_two_rates_T;
typedef struct tag_RTM_two_rates_T RT_MODEL_two_rates_T;

#endif
