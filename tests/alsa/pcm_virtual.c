/* A capture card made of a file: ALSA "ioplug" type `virtual`, paced by CLOCK_MONOTONIC.
 *
 * The tests need a card that keeps time, gives every row once and in order, and fails on demand, on
 * machines that have no sound card and no loopback module. The file's interleaved rows come round and
 * round; what nobody reads in time is lost, as on a real card. See alsa-lib, "PCM External Plugin SDK".
 *
 * A page shared with the test (struct control below) steers it while it runs. Keys in asound.conf:
 *   file, control: paths     channels, rate: of the file     format: S16_LE, S24_3LE, S32_LE or FLOAT_LE
 */
#include <alsa/asoundlib.h>
#include <alsa/pcm_external.h>
#include <errno.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

enum mode {
	RUN = 0,
	STALL = 1,  /* open and well, but no sample comes any more */
	ENDED = 2,  /* gone as a sound server goes: every call fails, poll too */
	REMOVED = 3 /* gone as a kernel card goes: poll returns at once, for ever, and calls give -ENODEV */
};

struct control {
	uint32_t mode;   /* in: enum mode */
	uint32_t xruns;  /* in: each step of it makes one overrun */
	int32_t ppm;     /* in: error of the card's clock */
	uint32_t skip;   /* in: rows thrown away in silence, in all */
	uint32_t opened; /* out: times that the card was opened */
	uint32_t closed; /* out: times that it was closed */
};

struct card {
	snd_pcm_ioplug_t io;
	volatile struct control *control;
	const char *rows;
	size_t bytes, row_bytes, row_count;
	double rate;
	int timer;
	int64_t started_ns;
	uint64_t made; /* rows that the clock has made since the start */
	uint64_t read; /* rows of these that were read */
	uint64_t base; /* rows before the start: time goes on while the card stands */
	uint32_t xruns_seen;
};

static int64_t now_ns(void)
{
	struct timespec t;
	clock_gettime(CLOCK_MONOTONIC, &t);
	return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static int gone(const struct card *card)
{
	return card->control->mode >= ENDED;
}

/* Wake whoever polls every `ns`; 0: never. */
static void wake_every(const struct card *card, int64_t ns)
{
	struct timespec t = {.tv_sec = ns / 1000000000, .tv_nsec = ns % 1000000000};
	struct itimerspec timer = {.it_interval = t, .it_value = t};
	timerfd_settime(card->timer, 0, &timer, NULL);
}

static int card_prepare(snd_pcm_ioplug_t *io)
{
	return gone(io->private_data) ? -ENODEV : 0;
}

static int card_start(snd_pcm_ioplug_t *io)
{
	struct card *card = io->private_data;
	if (gone(card))
		return -ENODEV;
	card->started_ns = now_ns();
	card->made = card->read = 0;
	wake_every(card, 1000000000LL * (int64_t)io->period_size / io->rate / 8);
	return 0;
}

static int card_stop(snd_pcm_ioplug_t *io)
{
	struct card *card = io->private_data;
	wake_every(card, 0);
	card->base += card->made; /* rows made and not read are lost */
	card->made = card->read = 0;
	return 0;
}

static snd_pcm_sframes_t card_pointer(snd_pcm_ioplug_t *io)
{
	struct card *card = io->private_data;
	if (gone(card)) {
		snd_pcm_ioplug_set_state(io, SND_PCM_STATE_DISCONNECTED);
		return -ENODEV;
	}
	if (card->xruns_seen != card->control->xruns) {
		card->xruns_seen = card->control->xruns;
		return -EPIPE;
	}
	if (card->control->mode == STALL)
		return (snd_pcm_sframes_t)(card->made % io->buffer_size);
	uint64_t made =
		(uint64_t)((double)(now_ns() - card->started_ns) * 1e-9 * card->rate * (1.0 + 1e-6 * card->control->ppm));
	uint64_t skip = card->control->skip;
	if (made > card->made + skip)
		card->made = made - skip; /* else just skipped: a pointer stands, and never goes back */
	if (card->made - card->read > io->buffer_size)
		return -EPIPE;
	return (snd_pcm_sframes_t)(card->made % io->buffer_size);
}

static snd_pcm_sframes_t card_transfer(snd_pcm_ioplug_t *io, const snd_pcm_channel_area_t *areas,
				       snd_pcm_uframes_t offset, snd_pcm_uframes_t size)
{
	struct card *card = io->private_data;
	char *to = (char *)areas->addr + (areas->first + areas->step * offset) / 8;
	if (gone(card))
		return -ENODEV;
	for (snd_pcm_uframes_t i = 0; i < size; i++) {
		uint64_t row = (card->base + card->control->skip + card->read + i) % card->row_count;
		memcpy(to + i * card->row_bytes, card->rows + row * card->row_bytes, card->row_bytes);
	}
	card->read += size;
	return (snd_pcm_sframes_t)size;
}

static int card_revents(snd_pcm_ioplug_t *io, struct pollfd *fds, unsigned int count, unsigned short *revents)
{
	struct card *card = io->private_data;
	uint64_t ticks;
	(void)count;
	if (fds->revents & POLLIN && read(card->timer, &ticks, sizeof ticks) < 0 && errno != EAGAIN)
		return -errno;
	*revents = 0;
	if (card->control->mode == ENDED) {
		*revents = POLLERR | POLLNVAL;
		return -ENODEV;
	}
	if (card->control->mode == REMOVED) {
		wake_every(card, 1); /* poll never waits again */
		snd_pcm_ioplug_set_state(io, SND_PCM_STATE_DISCONNECTED);
		*revents = POLLERR | POLLNVAL;
		return 0;
	}
	snd_pcm_sframes_t available = snd_pcm_avail_update(io->pcm);
	if (available < 0)
		*revents = POLLERR | POLLIN;
	else if ((snd_pcm_uframes_t)available >= io->period_size)
		*revents = POLLIN;
	return 0;
}

static void card_free(struct card *card)
{
	if (card->timer >= 0)
		close(card->timer);
	if (card->rows)
		munmap((void *)card->rows, card->bytes);
	if (card->control)
		munmap((void *)card->control, sizeof *card->control);
	free(card);
}

static int card_close(snd_pcm_ioplug_t *io)
{
	struct card *card = io->private_data;
	card->control->closed++;
	card_free(card);
	return 0;
}

static const snd_pcm_ioplug_callback_t callbacks = {
	.prepare = card_prepare,
	.start = card_start,
	.stop = card_stop,
	.pointer = card_pointer,
	.transfer = card_transfer,
	.poll_revents = card_revents,
	.close = card_close,
};

/* The whole file at `path`, shared; its size to `bytes`. */
static void *map_file(const char *path, int flags, int protection, size_t *bytes)
{
	struct stat status;
	void *map = MAP_FAILED;
	int fd = path ? open(path, flags) : -1;
	if (fd < 0)
		return NULL;
	if (fstat(fd, &status) == 0 && status.st_size > 0) {
		*bytes = (size_t)status.st_size;
		map = mmap(NULL, *bytes, protection, MAP_SHARED, fd, 0);
	}
	close(fd);
	return map == MAP_FAILED ? NULL : map;
}

static int card_limits(struct card *card, unsigned int channels, snd_pcm_format_t format)
{
	static const unsigned int access[] = {SND_PCM_ACCESS_RW_INTERLEAVED, SND_PCM_ACCESS_MMAP_INTERLEAVED};
	const unsigned int formats[] = {(unsigned int)format};
	const unsigned int rate = (unsigned int)card->rate, row = (unsigned int)card->row_bytes;
	const struct { int parameter; unsigned int least, most; } ranges[] = {
		{SND_PCM_IOPLUG_HW_CHANNELS, channels, channels},
		{SND_PCM_IOPLUG_HW_RATE, rate, rate},
		{SND_PCM_IOPLUG_HW_PERIOD_BYTES, row * (rate / 1000), row * (rate / 5)},
		{SND_PCM_IOPLUG_HW_BUFFER_BYTES, row * (rate / 500), row * rate},
		{SND_PCM_IOPLUG_HW_PERIODS, 2, 64},
	};
	int error = snd_pcm_ioplug_set_param_list(&card->io, SND_PCM_IOPLUG_HW_ACCESS, 2, access);
	if (error >= 0)
		error = snd_pcm_ioplug_set_param_list(&card->io, SND_PCM_IOPLUG_HW_FORMAT, 1, formats);
	for (size_t i = 0; error >= 0 && i < sizeof ranges / sizeof *ranges; i++)
		error = snd_pcm_ioplug_set_param_minmax(&card->io, ranges[i].parameter, ranges[i].least, ranges[i].most);
	return error;
}

SND_PCM_PLUGIN_DEFINE_FUNC(virtual)
{
	const char *file = NULL, *control = NULL;
	const char *format_name = "S16_LE";
	long channels = 4, rate = 48000;
	size_t control_bytes = 0;
	snd_config_iterator_t i, next;
	(void)root;
	if (stream != SND_PCM_STREAM_CAPTURE)
		return -EINVAL;
	snd_config_for_each(i, next, conf) {
		snd_config_t *entry = snd_config_iterator_entry(i);
		const char *key;
		if (snd_config_get_id(entry, &key) < 0)
			continue;
		if (!strcmp(key, "file"))
			snd_config_get_string(entry, &file);
		else if (!strcmp(key, "control"))
			snd_config_get_string(entry, &control);
		else if (!strcmp(key, "channels"))
			snd_config_get_integer(entry, &channels);
		else if (!strcmp(key, "rate"))
			snd_config_get_integer(entry, &rate);
		else if (!strcmp(key, "format"))
			snd_config_get_string(entry, &format_name);
	}

	snd_pcm_format_t format = snd_pcm_format_value(format_name);
	if (snd_pcm_format_physical_width(format) <= 0)
		return -EINVAL;

	struct card *card = calloc(1, sizeof *card);
	if (!card)
		return -ENOMEM;
	card->timer = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
	card->control = map_file(control, O_RDWR, PROT_READ | PROT_WRITE, &control_bytes);
	card->rows = map_file(file, O_RDONLY, PROT_READ, &card->bytes);
	card->rate = (double)rate;
	card->row_bytes = (size_t)channels * (size_t)snd_pcm_format_physical_width(format) / 8;
	card->row_count = card->bytes / card->row_bytes;
	int error = -ENOENT;
	if (card->timer < 0 || control_bytes < sizeof *card->control || !card->row_count)
		goto fail;
	error = -ENODEV;
	if (gone(card))
		goto fail;
	card->xruns_seen = card->control->xruns;
	card->io.version = SND_PCM_IOPLUG_VERSION;
	card->io.name = "virtual capture card";
	card->io.callback = &callbacks;
	card->io.private_data = card;
	card->io.poll_fd = card->timer;
	card->io.poll_events = POLLIN;
	error = snd_pcm_ioplug_create(&card->io, name, stream, mode);
	if (error < 0)
		goto fail;
	error = card_limits(card, (unsigned int)channels, format);
	if (error < 0) {
		snd_pcm_ioplug_delete(&card->io); /* closes and frees */
		return error;
	}
	card->control->opened++;
	*pcmp = card->io.pcm;
	return 0;
fail:
	card_free(card);
	return error;
}
SND_PCM_PLUGIN_SYMBOL(virtual);
