/* Writing JSON (RFC 8259). */
#ifndef FLOTILLA_JSON_H
#define FLOTILLA_JSON_H

#include <stdio.h>

/* A string, which is UTF-8, in quotes. */
void json_string(const char *text, FILE *out);

/* A further member of an object, `, "name": "text"`; nothing where the text is NULL or empty. */
void json_member(const char *name, const char *text, FILE *out);

/* A further member that is a number; nothing where it is not finite, which JSON cannot say. */
void json_number(const char *name, double value, FILE *out);

#endif
