/* Numbers in the text of a device. The C library's own accept more than a device says: exponents, signs, "inf". */
#ifndef FLOTILLA_DEVICES_TEXT_H
#define FLOTILLA_DEVICES_TEXT_H

#include <stdbool.h>
#include <stdint.h>

/* The value of a digit in capitals, as all these devices write them; -1 for another character. */
static inline int hexadecimal(char digit)
{
    if (digit >= '0' && digit <= '9')
        return digit - '0';
    return digit >= 'A' && digit <= 'F' ? digit - 'A' + 10 : -1;
}

/* Read (-)ddd(.ddd), and advance. False when there is no digit, or more than fit a double exactly. */
static inline bool read_decimal(const char **text, double *value)
{
    const char *at = *text;
    bool negative = *at == '-';
    int64_t digits = 0, scale = 1;
    int count = 0;
    at += negative;
    for (bool fraction = false;; at++) {
        if (*at == '.' && !fraction) {
            fraction = true;
            continue;
        }
        if (*at < '0' || *at > '9')
            break;
        if (++count > 15)
            return false;
        digits = digits * 10 + (*at - '0');
        scale *= fraction ? 10 : 1;
    }
    if (!count)
        return false;
    *value = (negative ? -1.0 : 1.0) * (double)digits / (double)scale;
    *text = at;
    return true;
}

/* Read one to `most` hexadecimal digits, and advance. False when there is none. */
static inline bool read_hexadecimal(const char **text, int most, uint32_t *value)
{
    const char *at = *text;
    *value = 0;
    for (int digit; most > 0 && (digit = hexadecimal(*at)) >= 0; at++, most--)
        *value = *value << 4 | (uint32_t)digit;
    bool any = at != *text;
    *text = at;
    return any;
}

#endif
