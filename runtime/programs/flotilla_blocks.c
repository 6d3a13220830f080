/* flotilla-blocks: lists the blocks that tasks can use. */
#define _GNU_SOURCE
#include "executive/registry.h"
#include "legacy_code.h"
#include "listing.h"

#include <getopt.h>

static const char usage[] =
    "usage: flotilla-blocks [--blocks DIRECTORY] [--json] [NAME [PARAMETER=VALUE]...]...\n"
    "       flotilla-blocks [--blocks DIRECTORY] --legacy-code [--out DIRECTORY] [NAME [PARAMETER=VALUE]...]...\n"
    "List all blocks, a line each; of the named ones all ports and parameters. Ports may depend on parameters.\n"
    "  --json              all that is known of all or of the named ones, for programs\n"
    "  --legacy-code       make Simulink blocks of all or of the named ones: write a script for its Legacy Code Tool,\n"
    "                      and the C files that it takes; parameters with a VALUE are fixed, the others Simulink's\n"
    "  --out DIRECTORY     where to (default: .)\n"
    "  --blocks DIRECTORY  plug-ins with further blocks (default: " FLOTILLA_BLOCKS "); several are separated by ':'\n"
    "  --help, --version\n";

int main(int argc, char **argv)
{
    static const struct option options[] = {{"blocks", required_argument, NULL, 'b'},
                                            {"json", no_argument, NULL, 'j'},
                                            {"legacy-code", no_argument, NULL, 'l'},
                                            {"out", required_argument, NULL, 'o'},
                                            {"help", no_argument, NULL, 'h'},
                                            {"version", no_argument, NULL, 'v'},
                                            {0}};
    const char *blocks = FLOTILLA_BLOCKS, *out = ".";
    bool legacy_code = false, json = false;
    struct registry registry = {0};
    for (int option; (option = getopt_long(argc, argv, "", options, NULL)) != -1;) {
        switch (option) {
        case 'b':
            blocks = optarg;
            break;
        case 'j':
            json = true;
            break;
        case 'l':
            legacy_code = true;
            break;
        case 'o':
            out = optarg;
            break;
        case 'h':
            fputs(usage, stdout);
            return 0;
        case 'v':
            printf("flotilla-blocks " FLOTILLA_VERSION ", interface %u of blocks\n", FL_ABI);
            return 0;
        default:
            fputs(usage, stderr);
            return 2;
        }
    }
    unsigned faults = registry_fill(&registry, blocks, stderr);
    faults += registry_load_plugins(&registry);
    bool good = legacy_code ? legacy_code_write(&registry, argv + optind, argc - optind, out)
                            : listing_write(&registry, argv + optind, argc - optind, json, stdout);
    registry_clear(&registry);
    return !good ? 2 : faults ? 1 : 0;
}
