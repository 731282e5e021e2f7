// Gradio cannot cancel an event before it has read the server's answer to the request to join the queue.
const joins = new Set();
const load = window.fetch;
const wait = (ms) => new Promise((wake) => setTimeout(wake, ms));

window.fetch = (...given) => {
    const answer = load(...given);
    if (String(given[0].url ?? given[0]).includes("/queue/join")) {
        const body = answer.then((response) => response.clone().text());
        joins.add(body);
        const forget = () => joins.delete(body);
        body.then(forget, forget);
    }
    return answer;
};

// Resolves when the requests made until now are answered, and the answers are read; after 10 s at the latest.
window.joinsAnswered = async () => {
    await wait(100); // the events of a click join one after the other
    await Promise.race([Promise.allSettled(joins), wait(10_000)]);
    await wait(100);
};
