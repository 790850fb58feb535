/* What multiply-adds take under an emulator: eight of the same instruction in a loop, the best of five. `tests/aarch64 emulator`
 * builds it. Nothing that it prints says how fast a processor is. */
#include <stdio.h>
#include <time.h>

static double seconds(void)
{
    struct timespec time;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
    return (double)time.tv_sec + (double)time.tv_nsec * 1e-9;
}

#define FOUR(x) x "\n" x "\n" x "\n" x "\n"
#define ROUNDS 100000

/* `work` is how many multiply-adds an instruction is. */
#define ROW(instruction, work)                                                                                     \
    do {                                                                                                           \
        double best = 1e9;                                                                                         \
        for (int run = 0; run < 5; run++) {                                                                        \
            __asm__ volatile("movi v0.4s, #0" ::: "v0");                                                           \
            double start = seconds();                                                                              \
            for (int round = 0; round < ROUNDS; round++)                                                           \
                __asm__ volatile(FOUR(instruction) FOUR(instruction) ::: "x0", "v0");                              \
            double time = seconds() - start;                                                                       \
            if (time < best) best = time;                                                                          \
        }                                                                                                          \
        best *= 1e9 / (8.0 * ROUNDS);                                                                              \
        printf("| `%s` | %d | %.1f | %.2f |\n", instruction, work, best, best / (work));                           \
    } while (0)

int main(void)
{
    printf("| instruction | multiply-adds | ns | ns a multiply-add |\n|---|---|---|---|\n");
    /* The first inexact result ever makes QEMU take its fast way from then on; any real program has one. */
    __asm__ volatile("fmov v1.4s, #1.0\nfmov v2.4s, #3.0\nfdiv v2.4s, v1.4s, v2.4s\n" ::: "v1", "v2");
    ROW("fmadd s0, s1, s2, s0", 1);
    ROW("fmla v0.4s, v1.4s, v2.4s", 4);
    ROW("fmla v0.4s, v1.4s, v2.s[1]", 4);
    ROW("madd w0, w1, w2, w0", 1);
    ROW("smull v0.8h, v1.8b, v2.8b", 8);
    ROW("sdot v0.4s, v1.16b, v2.4b[1]", 16);
    ROW("smmla v0.4s, v1.16b, v2.16b", 32);
    return 0;
}
