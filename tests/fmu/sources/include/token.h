#define TOKEN "{f5b0c7f2-6a35-4e0b-8a3c-0d64a3f7c1d9}"
