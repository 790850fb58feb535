/*
 * voxcast.h: camera images to a semantic voxel grid on a CPU, from C.
 *
 * voxcast runs networks of the InverseMatrixVT3D family (arXiv 2401.12422). A ring of cameras goes in; a grid of voxels
 * with a class each comes out, with the same bits on every run, number of threads and instruction set. This file is the
 * manual of its C interface: conventions first, then every function. It is C99 and C++.
 *
 *
 * BUILDING
 *
 *     cargo rustc --release --lib --no-default-features --features capi --crate-type cdylib
 *     cc -std=c11 -Iinclude infer.c -Ltarget/release -lvoxcast -o infer
 *     LD_LIBRARY_PATH=target/release ./infer
 *
 * makes libvoxcast.so and a program that uses it. With `--crate-type staticlib` it is libvoxcast.a, which is linked
 * with
 *
 *     cc -std=c11 -Iinclude infer.c target/release/libvoxcast.a -lpthread -ldl -lm -o infer
 *
 * A profile with `panic = "abort"` would end the process where VOXCAST_INTERNAL is promised below.
 *
 *
 * ORDER OF CALLS
 *
 *     voxcast_abi                                     is the library the one of this header?
 *     voxcast_model_open                              weights; voxcast_model_network tells sizes
 *     voxcast_model_selftest                          at power-on: does this machine compute what it must?
 *     voxcast_rig_open, or                            the cameras' projection matrices, from a file
 *       voxcast_rig_builder_new, ..._build            or from their calibration
 *     voxcast_session_memory                          what the next call will take
 *     voxcast_session_new                             takes it
 *
 *     every frame, either                             or, as images arrive and time allows
 *       voxcast_session_run                             voxcast_session_set_camera
 *                                                       voxcast_session_step
 *     then voxcast_session_classes and its neighbours
 *
 *     voxcast_session_free, voxcast_rig_free, voxcast_model_free, in any order
 *
 * examples/infer.c is a whole program. docs/embedding.md says what suits a controller.
 *
 *
 * CONVENTIONS
 *
 * Status.     Functions that can fail return a voxcast_status, VOXCAST_OK (0) or one of the list below.
 *
 * Message.    Their last two arguments are room for one line of text that says what went wrong: which file, what was
 *             found, what was expected. At most `capacity` bytes are written, a NUL always among them; longer lines are
 *             cut between characters (UTF-8). It is the empty string where nothing went wrong. `message` may be NULL
 *             and `capacity` 0. VOXCAST_MESSAGE bytes hold nearly every line.
 *
 * Handles.    voxcast_model, voxcast_rig, voxcast_rig_builder and voxcast_session are made by functions whose name ends
 *             in _open, _from_bytes, _new or _build, which write the handle, or NULL where they fail, to the place that
 *             they are given. Each is the caller's, who frees it once with the _free of its type. Freeing NULL does
 *             nothing. Handles may be freed in any order: a session keeps the model and the matrices that it uses.
 *
 * Buffers.    All others are the caller's. Nothing that is passed is kept after the call returns, but for the bytes of
 *             voxcast_model_from_bytes; nothing that is returned has to be freed.
 *
 * Sizes.      A function that fills an array takes its address, its capacity and a place for its length, both in
 *             elements. With the address NULL it only tells the length. With too small a capacity it tells the length,
 *             writes nothing else and returns VOXCAST_BUFFER_TOO_SMALL. The place may be NULL if the address is not.
 *             Lengths are fixed when a session is made: asking once is enough.
 *
 * Structs     that may grow begin with `size`. Set it to sizeof of the struct and all that is not used to 0, which is a
 *             default everywhere. A library that knows less than the caller refuses what it does not know
 *             (VOXCAST_INVALID_ARGUMENT); one that knows more takes the rest as 0.
 *
 * NULL        in place of anything that is not said to be optional gives VOXCAST_INVALID_ARGUMENT, as do unknown
 *             constants and misaligned arrays. Pointers to memory that is not there, handles that were freed and
 *             capacities that are not true cannot be recognised.
 *
 * Threads.    Every function may be called from every thread. Models may be used by many calls at once; a session, a
 *             rig or a rig builder by one at a time. A call that finds another inside of the same handle does not wait:
 *             it returns VOXCAST_BUSY and has done nothing. A mutex, if one is needed, is the caller's. Freeing is the
 *             exception: nobody else may be using the handle, or use it later.
 *             A session computes on the thread that calls it and on the threads that its options ask for. They wait,
 *             after a short spin, when there is no work, and end with the session. After fork() only a process that is
 *             the parent may go on using handles.
 *
 * Memory.     Each function says whether it allocates. Those of the frame do not, unless they fail: a message is made
 *             where one is needed. Weights are read in place from the mapped file.
 *
 * Files       that are mapped (models and rigs) must not be changed while they are. Replacing one by renaming another
 *             over it is fine. docs/security.md tells what is checked and what cannot be.
 *
 * Bits.       The same model file, matrices and images give the same classes, logits and confidence, on every machine, whatever the
 *             options and the order and slicing of calls. docs/determinism.md has the terms. The floating-point
 *             environment must be the default one: round to nearest, no flush to zero.
 *
 * Bugs.       A panic of the Rust code does not cross this interface. The call returns VOXCAST_INTERNAL, and the handle
 *             that it was changing answers VOXCAST_POISONED from then on; it can be freed. Rust's panic hook writes a
 *             line to stderr; nothing else in the library prints, reads the environment or exits. An allocation that
 *             the system refuses is VOXCAST_TOO_LARGE where it is large; where it is small the process aborts, as Rust
 *             has it.
 */

#ifndef VOXCAST_H
#define VOXCAST_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The number of this interface. Programs that were compiled for another number do not work with the library. */
#define VOXCAST_ABI 1

/* Room that holds nearly every message. */
#define VOXCAST_MESSAGE 512

/* What a function returns: one of the constants below. */
typedef int32_t voxcast_status;

enum {
    /* Done. */
    VOXCAST_OK = 0,
    /* An argument that no caller should pass: NULL, an unknown constant, a wrong struct size, too many threads. */
    VOXCAST_INVALID_ARGUMENT = 1,
    /* The array does not fit its buffer. The length that it needs has been told. */
    VOXCAST_BUFFER_TOO_SMALL = 2,
    /* The operating system refused to open, read or map a file. */
    VOXCAST_IO = 3,
    /* Bytes are not what the format says: truncated, corrupt, of another version, out of range. */
    VOXCAST_FORMAT = 4,
    /* Sound input that does not belong here: a rig of another network, an image of another size, a camera too many. */
    VOXCAST_MISMATCH = 5,
    /* Understood, and not available: an instruction set of another CPU, logits or a confidence that the session does not keep. */
    VOXCAST_UNSUPPORTED = 6,
    /* More memory than there is, or than the formats can address. */
    VOXCAST_TOO_LARGE = 7,
    /* There is no complete frame yet. */
    VOXCAST_NO_RESULT = 8,
    /* Another call is using the handle, or a session the rig. Nothing was done. */
    VOXCAST_BUSY = 9,
    /* An earlier call has returned VOXCAST_INTERNAL. The handle can only be freed. */
    VOXCAST_POISONED = 10,
    /* A bug in voxcast. Please report the message. */
    VOXCAST_INTERNAL = 11,
    /* The machine, the build or the model's bytes do not compute what the model says that they must. */
    VOXCAST_SELFTEST_FAILED = 12
};

/* Weights and the network that they belong to. Never changes; any number of threads may use it at once. */
typedef struct voxcast_model voxcast_model;

/* Six sparse matrices that say which pixels each voxel is seen by. */
typedef struct voxcast_rig voxcast_rig;

/* Memory in which rigs are built. */
typedef struct voxcast_rig_builder voxcast_rig_builder;

/* Memory in which frames run, and the last two results. */
typedef struct voxcast_session voxcast_session;


/* ---- The library ------------------------------------------------------------------------------------------------ */

/* VOXCAST_ABI of the library. Compare it before anything else. */
uint32_t voxcast_abi(void);

/* The package's version, such as "0.1.0". A constant; not to be freed. */
const char *voxcast_version(void);

/* The name of a status, such as "VOXCAST_MISMATCH", or "unknown". A constant; not to be freed. */
const char *voxcast_status_name(voxcast_status status);


/* ---- Models ----------------------------------------------------------------------------------------------------- */

/*
 * Maps a model file, as `voxcast import` writes it, and checks all of it, which reads it once.
 *
 * path     NUL-terminated, in the system's encoding (UTF-8 outside of Unix).
 * Fails    VOXCAST_IO, VOXCAST_FORMAT.
 * Allocates what the file's header needs. The weights stay where they are mapped.
 */
voxcast_status voxcast_model_open(const char *path, voxcast_model **model, char *message, size_t capacity);

/*
 * A model from the bytes of such a file, which are used where they are. They must be aligned to 8, and must neither
 * change nor go away before the model and every session of it are freed: put them into the program, or into flash.
 *
 * Fails    VOXCAST_INVALID_ARGUMENT if they are not aligned, VOXCAST_FORMAT.
 * Allocates as voxcast_model_open.
 */
voxcast_status voxcast_model_from_bytes(
    const void *bytes, size_t length, voxcast_model **model, char *message, size_t capacity);

/* Frees a model. Sessions that use it keep it mapped until they are freed too. */
void voxcast_model_free(voxcast_model *model);

/* What a caller needs to know of a network. */
typedef struct voxcast_network {
    /* sizeof(voxcast_network), set by the caller. */
    size_t size;
    /* Cameras that it was trained for. A rig may have another number. */
    size_t cameras;
    /* Classes; 0 is empty space. At most 256. */
    size_t classes;
    /* Of an image, in pixels, after padding: an image's own, rounded up to multiples of 32, must be these. */
    size_t height;
    size_t width;
    /* Voxels of the result along x, y, z. */
    size_t grid[3];
    /* Their product: bytes of the classes. */
    size_t voxels;
    /* Metres in the lidar frame: { min, max } of x, of y, of z. */
    float bounds[3][2];
    /* The model file's checksum, by which a log can name it. */
    uint64_t checksum;
} voxcast_network;

/* Fills `network`, whose `size` must be set. Fails only on wrong arguments. Allocates nothing. */
voxcast_status voxcast_model_network(
    const voxcast_model *model, voxcast_network *network, char *message, size_t capacity);


/* ---- Options ---------------------------------------------------------------------------------------------------- */

/*
 * How a session or a rig builder runs. No option changes a result. Where a function takes options, NULL stands for all
 * defaults.
 */
typedef struct voxcast_options {
    /* sizeof(voxcast_options), set by the caller. */
    size_t size;
    /* Instruction set: "scalar", "avx2", "avx2-vnni", "avx512", "avx512-vnni", "neon", "neon-dot",
       "neon-i8mm"; NULL for the best that this CPU has. */
    const char *isa;
    /* Threads that compute: 0 or 1 for the calling thread alone, n for it and n - 1 of its own. At most 1024. */
    uint32_t threads;
    /* 1 to keep logits as well as classes. Ignored by rig builders. */
    uint32_t logits;
    /*
     * Work in one slice of voxcast_session_step, in multiply-adds; 0 for 50 million, one or two milliseconds of one core. A
     * slice is at least one tile of an operation for every thread. Ignored by rig builders.
     */
    uint64_t slice_cost;
    /* 1 to keep how sure the network is of every voxel. Ignored by rig builders. */
    uint32_t confidence;
    /* 0. */
    uint32_t reserved;
} voxcast_options;

/*
 * The power-on self-test: runs the stimulus that a model carries and compares every operation's result, in bits, with
 * what it must be. It takes the time of a frame of two cameras.
 *
 * options  the threads and the instruction set to test.
 * Fails    VOXCAST_SELFTEST_FAILED, with the first wrong operation and its stage in the message; VOXCAST_UNSUPPORTED if
 *          the model carries no self-test; VOXCAST_FORMAT if it carries a malformed one; VOXCAST_TOO_LARGE.
 * Allocates a session for two cameras, with logits, and frees it again.
 */
voxcast_status voxcast_model_selftest(
    const voxcast_model *model, const voxcast_options *options, char *message, size_t capacity);


/* ---- Rigs ------------------------------------------------------------------------------------------------------- */

/*
 * Maps a rig file, as `voxcast rig` writes it, and checks every number in it.
 *
 * model    the model whose network the rig is for; it need not outlive the rig.
 * cameras  how many the rig is for.
 * Fails    VOXCAST_IO, VOXCAST_FORMAT, VOXCAST_MISMATCH if it is for another network or number of cameras,
 *          VOXCAST_UNSUPPORTED if the file's version is not known.
 * Allocates little. The matrices stay where they are mapped.
 */
voxcast_status voxcast_rig_open(
    const voxcast_model *model, const char *path, size_t cameras, voxcast_rig **rig, char *message, size_t capacity);

/*
 * Whether a rig is that of these cameras, in this order. Sessions do not ask: with the rig of another calibration a frame
 * gathers other pixels than the scene's, without an error. Ask once, after opening a rig, where the calibration is at hand.
 *
 * lidar2img  per camera 16 numbers as for voxcast_rig_builder_build: the same numbers, in every bit, that it was built from.
 * known      becomes 1 if they are, 0 if the rig does not say from which it was built, as those of other programs do not.
 * Fails      VOXCAST_MISMATCH if it was built from others; the message says which cameras differ, or that the order does.
 *            VOXCAST_BUSY while the rig is being built.
 */
voxcast_status voxcast_rig_check(
    const voxcast_rig *rig, const float *lidar2img, size_t cameras, uint32_t *known, char *message, size_t capacity);

/* Frees a rig. A session that uses its matrices keeps them. */
void voxcast_rig_free(voxcast_rig *rig);

/*
 * A builder of rigs for `cameras` cameras and the model's network, on the threads and the instruction set of `options`.
 * The model need not outlive it.
 *
 * Fails    VOXCAST_FORMAT if there are 0 cameras, VOXCAST_TOO_LARGE, VOXCAST_UNSUPPORTED.
 * Allocates little; the builds do more.
 */
voxcast_status voxcast_rig_builder_new(
    const voxcast_model *model, size_t cameras, const voxcast_options *options, voxcast_rig_builder **builder,
    char *message, size_t capacity);

/* Frees a builder. The rigs that it built stay. */
void voxcast_rig_builder_free(voxcast_rig_builder *builder);

/*
 * Builds a rig.
 *
 * lidar2img  16 floats per camera, a 4x4 matrix row by row: it takes (x, y, z, 1), metres in the lidar frame, to
 *            (u d, v d, d, 1), u and v in pixels of the image before padding. The cameras come in the order of the
 *            network's training. No matrix is wrong: a camera that sees nothing of the grid has no part in it.
 * cameras    matrices, as many as the builder is for.
 * Fails      VOXCAST_MISMATCH if they are more or fewer, VOXCAST_TOO_LARGE.
 * Allocates  the rig, and what the builder keeps for the next one.
 */
voxcast_status voxcast_rig_builder_build(
    voxcast_rig_builder *builder, const float *lidar2img, size_t cameras, voxcast_rig **rig, char *message,
    size_t capacity);

/* Steps of voxcast_rig_builder_advance that a whole rig takes. 0 for NULL. */
size_t voxcast_rig_builder_steps(const voxcast_rig_builder *builder);

/*
 * Begins to rebuild a rig for another calibration in bounded steps, which voxcast_rig_builder_advance does. One that
 * was under way is dropped. Arguments and failures are those of voxcast_rig_builder_build.
 *
 * Allocates nothing once builder and rigs have grown to what the calibrations at hand need: see the next function.
 */
voxcast_status voxcast_rig_builder_begin(
    voxcast_rig_builder *builder, const float *lidar2img, size_t cameras, char *message, size_t capacity);

/*
 * Does some of what was begun.
 *
 * steps     how many of voxcast_rig_builder_steps; SIZE_MAX for all that are left.
 * rig       becomes the new rig with the last step and stays what it is until then. No session may be using its
 *           matrices: it is the spare one that voxcast_session_swap_rig leaves behind.
 * complete  1 if the rig is complete, else 0.
 * Fails     VOXCAST_BUSY if a session is using the rig, VOXCAST_MISMATCH if nothing was begun, VOXCAST_TOO_LARGE. The
 *           rig is as before then.
 * Allocates nothing once builder and rig have traded memory a few times: each build goes into what the rig had.
 */
voxcast_status voxcast_rig_builder_advance(
    voxcast_rig_builder *builder, size_t steps, voxcast_rig *rig, uint32_t *complete, char *message, size_t capacity);


/* ---- Sessions --------------------------------------------------------------------------------------------------- */

/*
 * Bytes that voxcast_session_new will take from the system for a rig of `cameras` cameras, exactly. Not among them: the
 * handle (below 4 KiB), the stacks of threads, and the model and the rig, which sessions share.
 *
 * Fails     VOXCAST_TOO_LARGE if it cannot be addressed, VOXCAST_UNSUPPORTED.
 * Allocates, and frees again, the plan of the session.
 */
voxcast_status voxcast_session_memory(
    const voxcast_model *model, size_t cameras, const voxcast_options *options, uint64_t *bytes, char *message,
    size_t capacity);

/*
 * Plans a session, takes all its memory and starts its threads. It keeps using the model and the rig's matrices when
 * their handles are freed.
 *
 * Fails     VOXCAST_MISMATCH if the rig is another network's, VOXCAST_TOO_LARGE if the system has not the memory,
 *           VOXCAST_UNSUPPORTED if the CPU has not the instruction set or the system not the threads.
 * Allocates what voxcast_session_memory says. Nothing later.
 */
voxcast_status voxcast_session_new(
    const voxcast_model *model, const voxcast_rig *rig, const voxcast_options *options, voxcast_session **session,
    char *message, size_t capacity);

/* Ends the session's threads and gives back its memory. */
void voxcast_session_free(voxcast_session *session);

/* Order of a pixel's three bytes. */
enum {
    /* Blue first, as OpenCV has it. */
    VOXCAST_BGR = 0,
    /* Red first. */
    VOXCAST_RGB = 1
};

/* An image where the caller has it: rows of 3-byte pixels, top to bottom. */
typedef struct voxcast_image {
    /* The first byte of the first row. */
    const uint8_t *pixels;
    /* Bytes from there on that may be read: at least (height - 1) * stride + 3 * width. */
    size_t length;
    /* Rows, and pixels of a row. Rounded up to multiples of 32 they must be the network's. */
    size_t height;
    size_t width;
    /* Bytes from the start of one row to the start of the next; 0 for 3 * width. */
    size_t stride;
    /* VOXCAST_BGR or VOXCAST_RGB. */
    int32_t order;
    /* 0. */
    int32_t reserved;
} voxcast_image;

/*
 * Runs one frame: every camera gets a new image, and all is computed before the call returns. What steps had begun is
 * dropped.
 *
 * images   one per camera, in the order of the rig's cameras.
 * Fails    VOXCAST_MISMATCH if their number or a size is wrong. The last result stays then.
 * Allocates nothing.
 */
voxcast_status voxcast_session_run(
    voxcast_session *session, const voxcast_image *images, size_t count, char *message, size_t capacity);

/*
 * Copies the next image of one camera, from 0. Its backbone runs with the next steps. Where the image before has not
 * been begun, it is replaced.
 *
 * Fails    VOXCAST_MISMATCH if there is no such camera or the size is wrong.
 * Allocates nothing.
 */
voxcast_status voxcast_session_set_camera(
    voxcast_session *session, size_t camera, const voxcast_image *image, char *message, size_t capacity);

/* What the amount of a budget counts. */
enum {
    /* Nothing: all that there is to do. Operations are not cut into slices. */
    VOXCAST_UNLIMITED = 0,
    /*
     * Nanoseconds for which slices run. No slice begins once less time is left than the longest of this and the last
     * frame took; one runs in any case. So a step is late only if a slice takes longer than all before it.
     */
    VOXCAST_NANOSECONDS = 1,
    /* Slices, at least one. They are cut the same on every machine with this number of threads. */
    VOXCAST_SLICES = 2
};

/* What a step came to. */
enum {
    /* There is nothing to do: no camera that counts has a new image, or one has not had any yet. */
    VOXCAST_IDLE = 0,
    /* The budget is spent; the frame is not complete. */
    VOXCAST_RUNNING = 1,
    /* A frame is complete, and the result is its own. */
    VOXCAST_COMPLETE = 2
};

/*
 * Does some of what is to be done: the backbones of cameras with a new image, then the fusion of all cameras. The last
 * complete result can be read meanwhile.
 *
 * budget   VOXCAST_UNLIMITED, VOXCAST_NANOSECONDS or VOXCAST_SLICES.
 * amount   how many of these.
 * step     VOXCAST_IDLE, VOXCAST_RUNNING or VOXCAST_COMPLETE.
 * Fails only on wrong arguments. Allocates nothing.
 */
voxcast_status voxcast_session_step(
    voxcast_session *session, int32_t budget, uint64_t amount, int32_t *step, char *message, size_t capacity);

/*
 * Leaves a camera out (masked 1), or takes it in again (0): a camera that has failed or is dirty. The result has the
 * bits of a rig without it. It needs no image then, and its backbone does not run. Takes effect at once; a fusion that
 * is under way starts again.
 *
 * Fails    VOXCAST_MISMATCH if there is no such camera.
 * Allocates nothing.
 */
voxcast_status voxcast_session_set_masked(
    voxcast_session *session, size_t camera, uint32_t masked, char *message, size_t capacity);

/*
 * Trades matrices: the session uses those of `rig` from now on, and `rig` has those that the session used. Takes effect
 * at once; a fusion that is under way starts again, and no backbone does.
 *
 * What `rig` has now can be rebuilt in place for the next calibration, unless another handle or session shares it. The
 * handle that the session was made with is such a one: free it once the session is made.
 *
 * Fails    VOXCAST_MISMATCH if the rig is not for this network and number of cameras. Nothing is traded then.
 * Allocates and frees nothing.
 */
voxcast_status voxcast_session_swap_rig(voxcast_session *session, voxcast_rig *rig, char *message, size_t capacity);


/* ---- Results ---------------------------------------------------------------------------------------------------- */

/*
 * The functions below copy from the last complete frame, which stays as it is while steps work on the next. Before the
 * first one is complete they tell lengths and otherwise fail with VOXCAST_NO_RESULT. They allocate nothing.
 *
 * Voxel (x, y, z) is at (x * Y + y) * Z + z, X, Y, Z being the network's grid. Its centre is at
 * min + (index + 0.5) * (max - min) / voxels on each axis.
 */

/* The class of each voxel; 0 is empty. The length is the network's `voxels`. */
voxcast_status voxcast_session_classes(
    voxcast_session *session, uint8_t *classes, size_t room, size_t *length, char *message, size_t capacity);

/*
 * The logits of each voxel, its classes side by side: voxel v and class k at v * classes + k. The length is voxels
 * times classes, which is much to copy.
 *
 * Fails    VOXCAST_UNSUPPORTED if the session's options did not ask for logits.
 */
voxcast_status voxcast_session_logits(
    voxcast_session *session, float *logits, size_t room, size_t *length, char *message, size_t capacity);

/*
 * The probability that each voxel is occupied, that is of any class but 0: 0 to 255 for 0 to 1. The length is `voxels`.
 *
 * It is a softmax of the logits, divided by the temperature that the model carries. How far it can be trusted is what
 * `voxcast eval --calibration` measures. Where a logit is no number, it is 0.
 *
 * Fails    VOXCAST_UNSUPPORTED if the session's options did not ask for the confidence.
 */
voxcast_status voxcast_session_confidence_occupied(
    voxcast_session *session, uint8_t *codes, size_t room, size_t *length, char *message, size_t capacity);

/* As above, the probability of each voxel's class, which may be 0. */
voxcast_status voxcast_session_confidence_class(
    voxcast_session *session, uint8_t *codes, size_t room, size_t *length, char *message, size_t capacity);

/*
 * By how many feature pixels each voxel is seen, masked cameras left out, at most 65535. Where it is 0 no camera sees
 * the place and the class is a guess from the surroundings: not "free" but "unknown". The length is `voxels`.
 */
voxcast_status voxcast_session_support(
    voxcast_session *session, uint16_t *support, size_t room, size_t *length, char *message, size_t capacity);

/*
 * One bit per voxel, whether its class is not 0: voxel v is bit v % 8, counted from the lowest, of byte v / 8. Bits
 * after the last voxel are 0. The length is voxels / 8, rounded up.
 */
voxcast_status voxcast_session_bits(
    voxcast_session *session, uint8_t *bits, size_t room, size_t *length, char *message, size_t capacity);

/* A camera's part in a result. */
typedef struct voxcast_camera {
    /* Which of its images was used: the first that it was given is 1. 0 if it had none, which only a masked one may. */
    uint64_t image;
    /* Completed frames since that image's backbone ran: 0 if it was new in this frame. */
    uint64_t age;
    /* 1 if the camera was left out. */
    uint32_t masked;
    /* 0. */
    uint32_t reserved;
} voxcast_camera;

/* Every camera's part. The length is the rig's number of cameras. */
voxcast_status voxcast_session_cameras(
    voxcast_session *session, voxcast_camera *cameras, size_t room, size_t *length, char *message, size_t capacity);

/*
 * The XXH3-64 of the classes, by which results are compared at a glance. In 16 hexadecimal digits it is what the
 * program `voxcast` prints.
 */
voxcast_status voxcast_session_digest(voxcast_session *session, uint64_t *digest, char *message, size_t capacity);

/*
 * The XXH3-64 of the logits as little-endian bytes, which is as long to compute as they are to read.
 *
 * Fails    VOXCAST_UNSUPPORTED if the session's options did not ask for logits.
 */
voxcast_status voxcast_session_logits_digest(
    voxcast_session *session, uint64_t *digest, char *message, size_t capacity);

/*
 * The longest time that a slice of voxcast_session_step took since the session was made, and the name of the operation
 * that it was a part of, cut to `room` bytes as messages are; `operation` may be NULL.
 *
 * Fails    VOXCAST_NO_RESULT if no step with a limited budget has run.
 */
voxcast_status voxcast_session_longest_slice(
    voxcast_session *session, uint64_t *nanoseconds, char *operation, size_t room, char *message, size_t capacity);

#ifdef __cplusplus
}
#endif

#endif
