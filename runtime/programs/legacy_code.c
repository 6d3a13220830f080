#define _GNU_SOURCE
#include "legacy_code.h"

#include "executive/block.h"
#include "named_block.h"

#include <ctype.h>
#include <errno.h>
#include <flotilla/inner.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#define NAME    "flotilla_simulink"
#define LIBRARY "flotilla_blocks"

enum { NAME_BYTES = 96, REASON_BYTES = 512, PORTS_BYTES = 1024 };

/* The block that is being written. */
struct subject {
    struct named_block named;
    char function[NAME_BYTES]; /* what its functions' names begin with */
};

/* Two languages for one list of arguments: the tool's specification of a function, and the function's head in C. */
enum language { SPECIFICATION, HEAD };

/* The tool has no integers of 64 bits: each is two of 32, the lower half first, as in the memory of robots. */
static bool is_halved(const struct fl_port *port)
{
    return port->type == FL_INT64 || port->type == FL_UINT64;
}

static unsigned width_of(const struct fl_port *port)
{
    return (unsigned)port->width * (is_halved(port) ? 2 : 1);
}

static const char *type_of(const struct fl_port *port)
{
    return fl_type_name(is_halved(port) ? FL_UINT32 : port->type);
}

static const char *c_type(const struct fl_port *port)
{
    static const char *const names[FL_TYPES] = {
        [FL_BOOLEAN] = "boolean_T", [FL_INT8] = "int8_T",    [FL_UINT8] = "uint8_T",   [FL_INT16] = "int16_T",
        [FL_UINT16] = "uint16_T",   [FL_INT32] = "int32_T",  [FL_UINT32] = "uint32_T", [FL_SINGLE] = "real32_T",
        [FL_DOUBLE] = "real_T",     [FL_INT64] = "uint32_T", [FL_UINT64] = "uint32_T",
    };
    return names[port->type];
}

static bool is_number(const struct fl_parameter *parameter)
{
    return parameter->kind == FL_KIND_BOOLEAN || parameter->kind == FL_KIND_INTEGER ||
           parameter->kind == FL_KIND_UNSIGNED || parameter->kind == FL_KIND_DOUBLE;
}

static bool is_tunable(const struct fl_parameter *parameter)
{
    return parameter->flags & FL_TUNABLE && is_number(parameter);
}

/* Whether parameters make its ports differ from those of its type. */
static bool has_made_ports(const struct subject *subject)
{
    return subject->named.block->in_count + subject->named.block->out_count >
           subject->named.type->input_count + subject->named.type->output_count;
}

/* Whether the mask in Simulink has the parameter. */
static bool is_masked(const struct subject *subject, const struct fl_parameter *parameter)
{
    if (named_block_value(&subject->named, parameter) || parameter->kind == FL_KIND_STRINGS)
        return false;
    return !has_made_ports(subject) || is_tunable(parameter) || parameter->kind == FL_KIND_DEVICE;
}

/* --- what a block needs --- */

/* Whether the Legacy Code Tool cannot have the block; if so, with the reason. */
static bool refuse(const struct subject *subject, char *reason)
{
    for (uint32_t i = 0; i < subject->named.type->parameter_count; i++) {
        const struct fl_parameter *parameter = &subject->named.type->parameters[i];
        if (parameter->default_value || named_block_value(&subject->named, parameter) || is_masked(subject, parameter))
            continue;
        snprintf(reason, REASON_BYTES, "parameter %s cannot be left to Simulink; write %s=VALUE behind the block",
                 parameter->name, parameter->name);
        return true;
    }
    return false;
}

/* Check that the tool can have the block; false with the reason. */
static bool examine(struct subject *subject, struct registry *registry, char *reason)
{
    return named_block_configure(&subject->named, registry, reason, REASON_BYTES) && !refuse(subject, reason);
}

/* --- lists of arguments --- */

static void put_separator(FILE *out, bool *first)
{
    if (!*first)
        fputs(", ", out);
    *first = false;
}

/* A parameter's number in the mask; the period is the first one. */
static unsigned place_of(const struct subject *subject, uint32_t parameter)
{
    unsigned place = 2;
    for (uint32_t i = 0; i < parameter; i++)
        place += is_masked(subject, &subject->named.type->parameters[i]);
    return place;
}

static void put_parameters(FILE *out, enum language language, const struct subject *subject, bool tunable)
{
    for (uint32_t i = 0; i < subject->named.type->parameter_count; i++) {
        const struct fl_parameter *parameter = &subject->named.type->parameters[i];
        const unsigned place = place_of(subject, i);
        const bool number = is_number(parameter), list = parameter->kind == FL_KIND_DOUBLES;
        if (!is_masked(subject, parameter) || (tunable && !is_tunable(parameter)))
            continue;
        if (language == HEAD)
            fprintf(out,
                    number ? ", real_T p%u"
                    : list ? ", const real_T *p%u, int32_T n%u"
                           : ", const uint8_T *p%u, int32_T n%u",
                    place, place);
        else
            fprintf(out,
                    number ? ", double p%u"
                    : list ? ", double p%u[], int32 numel(p%u)"
                           : ", uint8 p%u[], int32 numel(p%u)",
                    place, place);
    }
}

static void put_ports(FILE *out, enum language language, const struct fl_port *ports, uint32_t count, bool output)
{
    for (uint32_t i = 0; i < count; i++) {
        if (language == HEAD)
            fprintf(out, ", %s%s *%c%u", output ? "" : "const ", c_type(&ports[i]), output ? 'y' : 'u',
                    (unsigned)i + 1);
        else
            fprintf(out, ", %s %c%u[%u]", type_of(&ports[i]), output ? 'y' : 'u', (unsigned)i + 1, width_of(&ports[i]));
    }
}

static void put_start(FILE *out, enum language language, const struct subject *subject)
{
    fprintf(out, "void %s_start(void **work1, %s p1", subject->function, language == HEAD ? "real_T" : "double");
    put_parameters(out, language, subject, false);
    fputc(')', out);
}

static void put_step(FILE *out, enum language language, const struct subject *subject)
{
    fprintf(out, "void %s_step(void *work1", subject->function);
    put_ports(out, language, subject->named.block->in_ports, subject->named.block->in_count, false);
    put_ports(out, language, subject->named.block->out_ports, subject->named.block->out_count, true);
    put_parameters(out, language, subject, true);
    fputc(')', out);
}

static void put_terminate(FILE *out, const struct subject *subject)
{
    fprintf(out, "void %s_terminate(void *work1)", subject->function);
}

/* --- the files --- */

static const char *text_of(const char *text)
{
    return text ? text : "";
}

static void put_described_ports(FILE *out, const struct fl_port *ports, uint32_t count, char letter)
{
    for (uint32_t i = 0; i < count; i++)
        fprintf(out, "%%   %c%u  %s: %s%s%s%s\n", letter, (unsigned)i + 1, ports[i].name, text_of(ports[i].summary),
                *text_of(ports[i].unit) ? ", in " : "", text_of(ports[i].unit),
                is_halved(&ports[i]) ? "; of 64 bits, in two halves, the lower first" : "");
}

static void put_described_parameters(FILE *out, const struct subject *subject)
{
    fputs("%   p1  period in s of what calls it; 0: the model's fastest\n", out);
    for (uint32_t i = 0; i < subject->named.type->parameter_count; i++) {
        const struct fl_parameter *parameter = &subject->named.type->parameters[i];
        if (!is_masked(subject, parameter))
            continue;
        fprintf(out, "%%   p%u  %s: %s%s%s", place_of(subject, i), parameter->name, text_of(parameter->summary),
                *text_of(parameter->unit) ? ", in " : "", text_of(parameter->unit));
        if (!is_number(parameter) && parameter->kind != FL_KIND_DOUBLES)
            fputs("; a text: uint8('...')", out);
        if (parameter->choices)
            fprintf(out, "; one of %s", parameter->choices);
        if (parameter->default_value)
            fprintf(out, "; usually %s", *parameter->default_value ? parameter->default_value : "nothing");
        fputs(is_tunable(parameter) ? "; tunable\n" : "\n", out);
    }
}

/* As a string of MATLAB. */
static void put_characters(FILE *out, const char *text)
{
    for (; *text; text++)
        fprintf(out, *text == '\'' ? "''" : "%c", *text);
}

/* A parameter's name in its mask. Those of MATLAB's language and of blocks have an underscore behind them: Simulink
 * refuses a name that a block's own parameter has, in any case of letters. */
static void put_name(FILE *out, const char *name)
{
    static const char *const taken[] = {
        "break",       "case",       "catch",       "continue",   "else",         "end",        "for",
        "function",    "global",     "if",          "otherwise",  "parfor",       "persistent", "return",
        "switch",      "try",        "while",       "name",       "type",         "path",       "position",
        "priority",    "parameters", "ports",       "parent",     "tag",          "handle",     "orientation",
        "description", "selected",   "permissions", "sampletime", "functionname", "userdata",
    };
    fputs(name, out);
    for (size_t i = 0; i < sizeof taken / sizeof *taken; i++)
        if (strcasecmp(name, taken[i]) == 0)
            fputc('_', out);
}

/* What the mask has until somebody writes something else. */
static void put_value(FILE *out, const struct fl_parameter *parameter)
{
    const char *value = parameter->default_value;
    if (parameter->kind == FL_KIND_BOOLEAN)
        fputs(value && strcmp(value, "true") == 0 ? "1" : "0", out);
    else if (is_number(parameter) && value && strncmp(value, "0x", 2) == 0)
        fprintf(out, "%llu", strtoull(value, NULL, 16)); /* in MATLAB 0x1 is no double */
    else if (is_number(parameter))
        fputs(value ? value : "NaN", out); /* which no block accepts */
    else if (parameter->kind == FL_KIND_DOUBLES)
        fprintf(out, "[%s]", text_of(value));
    else
        fprintf(out, "uint8(''%s'')", text_of(value));
}

static void put_mask_parameter(FILE *out, const struct fl_parameter *parameter)
{
    fputs("mask.addParameter('Type', 'edit', 'Name', '", out);
    put_name(out, parameter->name);
    fprintf(out, "', 'Prompt', '%s: ", parameter->name);
    put_characters(out, text_of(parameter->summary));
    if (*text_of(parameter->unit)) {
        fputs(", in ", out);
        put_characters(out, parameter->unit);
    }
    if (parameter->choices)
        fprintf(out, " (%s)", parameter->choices);
    fputs("', 'Value', '", out);
    put_value(out, parameter);
    fprintf(out, "', 'Evaluate', 'on', 'Tunable', '%s');\n", is_tunable(parameter) ? "on" : "off");
}

static void put_block(FILE *out, const struct subject *subject, int index)
{
    enum { COLUMNS = 4, STEP_X = 220, STEP_Y = 140, WIDTH = 140, HEIGHT = 80, MARGIN = 40 };
    const char *shown = subject->function + strlen("flotilla_");
    const int x = MARGIN + index % COLUMNS * STEP_X, y = MARGIN + index / COLUMNS * STEP_Y;
    fprintf(out,
            "\nblock = '" LIBRARY "/%s';\n"
            "add_block('simulink/User-Defined Functions/S-Function', block, 'Position', [%d %d %d %d]);\n"
            "mask = Simulink.Mask.create(block);\n"
            "mask.Type = 'Flotilla %s';\nmask.Description = '",
            shown, x, y, x + WIDTH, y + HEIGHT, subject->named.type->name);
    put_characters(out, text_of(subject->named.type->summary));
    fputs(
        "';\n"
        "mask.addParameter('Type', 'edit', 'Name', 'period_s', 'Prompt', 'period_s: period of what calls it, in s; 0: "
        "the model''s fastest', 'Value', '0', 'Evaluate', 'on', 'Tunable', 'off');\n",
        out);
    for (uint32_t i = 0; i < subject->named.type->parameter_count; i++)
        if (is_masked(subject, &subject->named.type->parameters[i]))
            put_mask_parameter(out, &subject->named.type->parameters[i]);
    fprintf(out, "set_param(block, 'FunctionName', '%s', 'Parameters', 'period_s", subject->function);
    for (uint32_t i = 0; i < subject->named.type->parameter_count; i++)
        if (is_masked(subject, &subject->named.type->parameters[i])) {
            fputs(", ", out);
            put_name(out, subject->named.type->parameters[i].name);
        }
    fputs("');\n", out);
}

static void write_script(FILE *out, const struct subject *subjects, int count)
{
    fputs("% Flotilla's blocks for Simulink, by its Legacy Code Tool. Written by flotilla-blocks --legacy-code.\n"
          "% Run it where its C files lie. In simulation the blocks do nothing, and their outputs are zero.\n"
          "here = fileparts(mfilename('fullpath'));\n"
          "defs = [];\n",
          out);
    for (int i = 0; i < count; i++) {
        const struct subject *subject = &subjects[i];
        const struct fl_block *block = subject->named.block;
        fprintf(out, "\n%% %s: %s\n", subject->named.type->name, text_of(subject->named.type->summary));
        put_described_ports(out, block->in_ports, block->in_count, 'u');
        put_described_ports(out, block->out_ports, block->out_count, 'y');
        put_described_parameters(out, subject);
        fprintf(out, "def = legacy_code('initialize');\ndef.SFunctionName = '%s';\ndef.StartFcnSpec = '",
                subject->function);
        put_start(out, SPECIFICATION, subject);
        fputs("';\ndef.OutputFcnSpec = '", out);
        put_step(out, SPECIFICATION, subject);
        fputs("';\ndef.TerminateFcnSpec = '", out);
        put_terminate(out, subject);
        fputs("';\n"
              "def.HeaderFiles = {'" NAME ".h'};\n"
              "def.SourceFiles = {'" NAME ".c'};\n"
              "def.IncPaths = {here};\n"
              "def.SrcPaths = {here};\n"
              "def.SampleTime = 'inherited';\n"
              "def.Options.useTlcWithAccel = false;\n"
              "defs = [defs; def];\n",
              out);
    }
    fputs("\nlegacy_code('sfcn_cmex_generate', defs);\n"
          "legacy_code('compile', defs);\n"
          "legacy_code('sfcn_tlc_generate', defs);\n"
          "legacy_code('rtwmakecfg_generate', defs);\n"
          "\n% The library: blocks whose masks have the parameters by name.\n"
          "if bdIsLoaded('" LIBRARY "')\n"
          "    close_system('" LIBRARY "', 0);\n"
          "end\n"
          "load_system('simulink');\n"
          "new_system('" LIBRARY "', 'Library');\n",
          out);
    for (int i = 0; i < count; i++)
        put_block(out, &subjects[i], i);
    fputs("\nsave_system('" LIBRARY "', fullfile(here, '" LIBRARY ".slx'), 'OverwriteIfChangedOnDisk', true);\n", out);
}

static void write_header(FILE *out, const struct subject *subjects, int count)
{
    fputs("/* Flotilla's blocks as functions. Written by flotilla-blocks --legacy-code; " NAME
          ".m says what is what. */\n"
          "#ifndef FLOTILLA_SIMULINK_H\n"
          "#define FLOTILLA_SIMULINK_H\n"
          "\n"
          "#ifdef MATLAB_MEX_FILE\n"
          "#include \"tmwtypes.h\"\n"
          "#else\n"
          "#include \"rtwtypes.h\"\n"
          "#endif\n",
          out);
    for (int i = 0; i < count; i++) {
        fputc('\n', out);
        put_start(out, HEAD, &subjects[i]);
        fputs(";\n", out);
        put_step(out, HEAD, &subjects[i]);
        fputs(";\n", out);
        put_terminate(out, &subjects[i]);
        fputs(";\n", out);
    }
    fputs("\n#endif\n", out);
}

/* As a string of C. */
static void put_string(FILE *out, const char *text)
{
    fputc('"', out);
    for (; *text; text++) {
        if (isprint((unsigned char)*text) && !strchr("\"\\?", *text))
            fputc(*text, out);
        else
            fprintf(out, "\\%03o", (unsigned)(unsigned char)*text);
    }
    fputc('"', out);
}

static void write_start(FILE *out, const struct subject *subject)
{
    char ports[PORTS_BYTES];
    put_start(out, HEAD, subject);
    fputs("\n{\n    struct fl_inner *inner = fl_inner_new(", out);
    put_string(out, subject->named.type->name);
    fputs(", p1);\n", out);
    for (uint32_t i = 0; i < subject->named.type->parameter_count; i++) {
        const struct fl_parameter *parameter = &subject->named.type->parameters[i];
        const char *fixed = named_block_value(&subject->named, parameter), *name = parameter->name;
        const unsigned place = place_of(subject, i);
        if (fixed) {
            fprintf(out, "    fl_inner_parameter(inner, \"%s\", ", name);
            put_string(out, fixed);
            fprintf(out, ", %zu);\n", strlen(fixed));
        } else if (!is_masked(subject, parameter)) {
            continue;
        } else if (is_tunable(parameter)) {
            fprintf(out, "    fl_inner_tunable(inner, \"%s\", p%u);\n", name, place);
        } else if (is_number(parameter)) {
            fprintf(out, "    fl_inner_numbers(inner, \"%s\", &p%u, 1);\n", name, place);
        } else {
            fprintf(out, "    fl_inner_%s(inner, \"%s\", p%u, (size_t)n%u);\n",
                    parameter->kind == FL_KIND_DOUBLES ? "numbers" : "parameter", name, place, place);
        }
    }
    fl_inner_ports(subject->named.block, ports, sizeof ports);
    fprintf(out, "    fl_inner_start(inner, \"%s\");\n    *work1 = inner;\n}\n\n", ports);
}

static void write_pointers(FILE *out, const char *type, char letter, uint32_t count)
{
    fprintf(out, "    %s[] = {", type);
    for (uint32_t i = 0; i < count; i++)
        fprintf(out, "%c%u, ", letter, (unsigned)i + 1);
    fputs("NULL};\n", out);
}

static void write_step(FILE *out, const struct subject *subject)
{
    bool first = true;
    put_step(out, HEAD, subject);
    fputs("\n{\n", out);
    for (uint32_t i = 0; i < subject->named.type->parameter_count; i++) {
        const struct fl_parameter *parameter = &subject->named.type->parameters[i];
        if (!is_masked(subject, parameter) || !is_tunable(parameter))
            continue;
        if (first)
            fputs("    const double tuned[] = {", out);
        put_separator(out, &first);
        fprintf(out, "p%u", place_of(subject, i));
    }
    if (!first)
        fputs("};\n    fl_inner_tune(work1, tuned);\n", out);
    write_pointers(out, "const void *const in", 'u', subject->named.block->in_count);
    write_pointers(out, "void *const out", 'y', subject->named.block->out_count);
    fputs("    fl_inner_step(work1, in, out);\n}\n\n", out);
}

/* In simulation: nothing, but that no output is what another block left in its place. */
static void write_simulated(FILE *out, const struct subject *subject)
{
    put_start(out, HEAD, subject);
    fputs("\n{\n    (void)p1;\n", out);
    for (uint32_t i = 0; i < subject->named.type->parameter_count; i++) {
        const struct fl_parameter *parameter = &subject->named.type->parameters[i];
        if (is_masked(subject, parameter)) {
            fprintf(out, "    (void)p%u;\n", place_of(subject, i));
            if (!is_number(parameter))
                fprintf(out, "    (void)n%u;\n", place_of(subject, i));
        }
    }
    fputs("    *work1 = NULL;\n}\n\n", out);
    put_step(out, HEAD, subject);
    fputs("\n{\n    (void)work1;\n", out);
    for (uint32_t i = 0; i < subject->named.block->in_count; i++)
        fprintf(out, "    (void)u%u;\n", (unsigned)i + 1);
    for (uint32_t i = 0; i < subject->named.block->out_count; i++)
        fprintf(out, "    memset(y%u, 0, %u * sizeof *y%u);\n", (unsigned)i + 1,
                width_of(&subject->named.block->out_ports[i]), (unsigned)i + 1);
    for (uint32_t i = 0; i < subject->named.type->parameter_count; i++)
        if (is_masked(subject, &subject->named.type->parameters[i]) && is_tunable(&subject->named.type->parameters[i]))
            fprintf(out, "    (void)p%u;\n", place_of(subject, i));
    fputs("}\n\n", out);
    put_terminate(out, subject);
    fputs("\n{\n    (void)work1;\n}\n\n", out);
}

static void write_source(FILE *out, const struct subject *subjects, int count)
{
    fputs("/* Flotilla's blocks as functions. Written by flotilla-blocks --legacy-code. */\n"
          "#include \"" NAME ".h\"\n"
          "\n"
          "#ifdef MATLAB_MEX_FILE /* the computer that simulates has no devices */\n"
          "#include <string.h>\n\n",
          out);
    for (int i = 0; i < count; i++)
        write_simulated(out, &subjects[i]);
    fputs("#else\n#include <flotilla/inner.h>\n\n", out);
    for (int i = 0; i < count; i++) {
        write_start(out, &subjects[i]);
        write_step(out, &subjects[i]);
        put_terminate(out, &subjects[i]);
        fputs("\n{\n    fl_inner_terminate(work1);\n}\n\n", out);
    }
    fputs("#endif\n", out);
}

static bool write_file(const char *directory, const char *suffix,
                       void (*contents)(FILE *out, const struct subject *subjects, int count),
                       const struct subject *subjects, int count, FILE *messages)
{
    char path[4096];
    snprintf(path, sizeof path, "%s/" NAME "%s", directory, suffix);
    FILE *out = fopen(path, "we");
    if (out)
        contents(out, subjects, count);
    if (!out || fflush(out) || ferror(out)) {
        fprintf(messages, "%s: cannot be written: %s\n", path, strerror(errno));
        if (out)
            fclose(out);
        return false;
    }
    fclose(out);
    printf("%s\n", path);
    return true;
}

/* --- which blocks --- */

/* A C identifier; the second block of a type has _2 at its end. */
static void name(struct subject *subjects, int index)
{
    struct subject *subject = &subjects[index];
    unsigned same = 1;
    for (int i = 0; i < index; i++)
        same += subjects[i].named.type == subject->named.type;
    snprintf(subject->function, sizeof subject->function, "flotilla_%.60s", subject->named.type->name);
    for (char *at = subject->function; *at; at++)
        if (!isalnum((unsigned char)*at))
            *at = '_';
    size_t length = strlen(subject->function);
    if (same > 1)
        snprintf(subject->function + length, sizeof subject->function - length, "_%u", same);
}

bool legacy_code_write(struct registry *registry, char *const *words, int count, const char *directory)
{
    char reason[REASON_BYTES];
    struct subject *subjects = calloc((size_t)count + registry->count + 1, sizeof *subjects);
    struct named_block *blocks = calloc((size_t)count + registry->count + 1, sizeof *blocks);
    if (!subjects || !blocks)
        abort();
    int found = named_blocks(registry, words, count, blocks), usable = 0;
    if (!count)
        for (size_t i = 0; i < registry->count; i++)
            blocks[found++].type = registry->types[i];
    bool good = found >= 0;
    for (int i = 0; i < found; i++) {
        subjects[usable].named = blocks[i];
        name(subjects, usable);
        if (examine(&subjects[usable], registry, reason)) {
            usable++;
            continue;
        }
        fprintf(registry->out, "%s: %s%s\n", subjects[usable].named.type->name, count ? "" : "left out: ", reason);
        good = good && !count;
        block_destroy(subjects[usable].named.outer);
    }
    good = good && write_file(directory, ".m", write_script, subjects, usable, registry->out) &&
           write_file(directory, ".h", write_header, subjects, usable, registry->out) &&
           write_file(directory, ".c", write_source, subjects, usable, registry->out);
    for (int i = 0; i < usable; i++)
        block_destroy(subjects[i].named.outer);
    free(subjects);
    free(blocks);
    return good;
}
