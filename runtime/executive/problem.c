#include "problem.h"

#include "core/service.h"

void problem(struct problems *problems, unsigned line, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    problems->count++;
    fputs(fl_priority(FL_ERROR), problems->out);
    if (line)
        fprintf(problems->out, "%s:%u: ", problems->file, line);
    else
        fprintf(problems->out, "%s: ", problems->file);
    vfprintf(problems->out, format, arguments);
    fputc('\n', problems->out);
    va_end(arguments);
}
