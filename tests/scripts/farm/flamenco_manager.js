// What Flamenco's manager gives to job type scripts, as its documentation and built-in scripts use it. Tasks are kept with their dependencies' names.
const author = {
    Task: (name, type) => {
        if (!name.trim() || !type.trim()) throw new Error("author.Task(name, type): both are required");
        const task = { name: name.trim(), type: type.trim(), commands: [], dependencies: [] };
        Object.defineProperty(task, "addCommand", { value: (command) => { task.commands.push(command); } });
        Object.defineProperty(task, "addDependency", { value: (other) => { task.dependencies.push(other.name); } });
        return task;
    },
    Command: (name, parameters, totalStepCount) => ({ name: name, parameters: parameters, totalStepCount: totalStepCount || 0 }),
};
const path = { join: (...parts) => parts.join("/"), basename: (p) => p.split("/").pop(), dirname: (p) => p.split("/").slice(0, -1).join("/") };
function print() {}
function shellSplit(text) { return text.match(/(?:[^\s"']+|"[^"]*"|'[^']*')+/g).map((word) => word.replace(/["']/g, "")); }
function compiled(settings) {
    const job = { settings: settings, tasks: [] };
    job.addTask = (task) => { job.tasks.push(task); };
    compileJob(job);
    return JSON.stringify(job.tasks);
}
