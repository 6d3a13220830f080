#include "json.h"

#include <math.h>

void json_string(const char *text, FILE *out)
{
    fputc('"', out);
    for (const unsigned char *at = (const unsigned char *)text; *at; at++) {
        if (*at < ' ')
            fprintf(out, "\\u%04x", *at);
        else
            fprintf(out, *at == '"' || *at == '\\' ? "\\%c" : "%c", *at);
    }
    fputc('"', out);
}

void json_member(const char *name, const char *text, FILE *out)
{
    if (!text || !*text)
        return;
    fprintf(out, ", \"%s\": ", name);
    json_string(text, out);
}

void json_number(const char *name, double value, FILE *out)
{
    if (isfinite(value))
        fprintf(out, ", \"%s\": %.17g", name, value);
}
